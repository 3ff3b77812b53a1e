"""Access to every route; the routes are taken from the OpenAPI document and the app, so that none is forgotten."""

from base64 import b64encode

import httpx
import pytest
from starlette.routing import Mount, Route

from service.base.errors import StatusError
from tests.status.conftest import serve
from tests.status.runs import CLIENT, TOKEN, WRONG

PARAMETERS = {
    "run_id": "old",
    "name": "tiny",
    "version": "1",
    "file": "rounds.mp4",
    "alias": "by-test",
    "digest": "0" * 64,
}
BODIES = {"put": {"version": 1}}
PROBES = {"/readyz"}
OPEN = {"/livez", "/", "/page/index.html", "/page/plotly.js"}
"""The page itself holds no secret, and has a form for the token."""
SESSION = "/v1/session"
"""Takes the token in its body; it has tests of its own."""


RIGHT = f"Bearer {TOKEN}"
REFUSED = {
    "bearer": f"Bearer {WRONG}",
    "shorter": f"Bearer {TOKEN[:-1]}",
    "empty": "Bearer",
    "another scheme": f"Basic {TOKEN}",
    "user and password": f"Basic {b64encode(f'tandem:{TOKEN}'.encode()).decode()}",
    "not ASCII": "Bearer \u00e9\u00e9\u00e9",
}


def routes(server):
    """Method and path of every route, and of one that does not exist."""
    documented = {
        (method, path.format(**PARAMETERS))
        for path, methods in server.app.openapi()["paths"].items()
        for method in methods
        if path != SESSION
    }
    hidden = {
        ("get", "/"),
        ("get", "/openapi.json"),
        ("get", "/page/index.html"),
        ("get", "/page/plotly.js"),
        ("get", "/v1/nope"),
        ("post", "/v1/nope"),
    }
    return sorted(documented | hidden)


def ask(client, method, path, authorization=None):
    headers = {} if authorization is None else {"Authorization": authorization.encode("latin-1")}
    return client.request(method, path, headers=headers, json=BODIES.get(method))


@pytest.fixture(scope="module")
def public(home):
    """A service on a public address, and a client on loopback."""
    with serve(home, host="0.0.0.0") as server, httpx.Client(base_url=server.url, **CLIENT) as client:
        yield server, client


def with_included(routes):
    """Routes, and in place of each router that was included its own."""
    for route in routes:
        router = getattr(route, "original_router", None)
        if router is None:
            assert isinstance(route, Route | Mount), route
            yield route
        else:
            yield from with_included(router.routes)


def test_the_matrix_knows_every_route_of_the_app(server):
    known = {path for _, path in routes(server)} | {"/page", SESSION}
    found = {route.path.format(**PARAMETERS) for route in with_included(server.app.routes)}
    assert {"/livez", "/metrics", "/", "/page", "/v1/runs", "/v1/primitives"} <= found
    assert found <= known


def test_a_public_service_answers_nobody_without_its_token(public):
    server, client = public
    for method, path in routes(server):
        expected = 200 if path in OPEN | PROBES else 401
        answer = ask(client, method, path)
        assert answer.status_code == expected, (method, path)
        if expected == 401:
            assert answer.headers["www-authenticate"].startswith("Bearer")
            assert answer.json()["type"] == "urn:tandem:missing-token"


@pytest.mark.parametrize("kind", REFUSED)
def test_a_public_service_refuses_what_is_not_its_token(public, kind):
    server, client = public
    for method, path in routes(server):
        expected = 200 if path in OPEN else 401
        assert ask(client, method, path, REFUSED[kind]).status_code == expected, (method, path)


def test_a_public_service_answers_with_its_token(public):
    server, client = public
    for method, path in routes(server):
        status = ask(client, method, path, RIGHT).status_code
        assert status < 500, (method, path)
        assert status not in (401, 403), (method, path)


def test_a_session_reads_and_changes_nothing(public):
    server, _ = public
    with httpx.Client(base_url=server.url, **CLIENT) as browser:
        answer = browser.post(SESSION, json={"token": WRONG})
        assert (answer.status_code, answer.json()["type"]) == (401, "urn:tandem:wrong-token")
        assert browser.get("/v1/runs").status_code == 401
        answer = browser.post(SESSION, json={"token": f" {TOKEN}\n"})
        assert answer.json() == {"status": "open"}
        said = answer.headers["set-cookie"].lower()
        assert "httponly" in said
        assert "samesite=strict" in said
        assert f"max-age={7 * 86_400}" in said
        assert TOKEN not in said
        assert browser.get("/v1/runs").status_code == 200
        assert browser.post("/v1/runs/old/stop").status_code == 401
        cookie = browser.cookies["tandem_session"]
        for forged in (cookie[:-1], TOKEN, '"', "\u00e9".encode("latin-1").decode("latin-1")):
            header = f"tandem_session={forged}".encode("latin-1")
            assert httpx.get(f"{server.url}/v1/runs", headers={"Cookie": header}, **CLIENT).status_code == 401


def test_a_session_ends_when_the_service_gets_another_token(public, home):
    server, _ = public
    cookies = httpx.post(f"{server.url}{SESSION}", json={"token": TOKEN}, **CLIENT).cookies
    assert httpx.get(f"{server.url}/v1/runs", cookies=cookies, **CLIENT).status_code == 200
    with serve(home, host="0.0.0.0", token=WRONG) as other:
        assert httpx.get(f"{other.url}/v1/runs", cookies=cookies, **CLIENT).status_code == 401


def test_without_a_token_there_is_no_session(home):
    with serve(home, token=None) as server:
        answer = httpx.post(f"{server.url}{SESSION}", json={"token": TOKEN}, **CLIENT)
    assert (answer.status_code, answer.json()["type"]) == (403, "urn:tandem:read-only")


def test_on_loopback_reading_is_free_changing_is_not_and_a_wrong_token_is_refused(server):
    with httpx.Client(base_url=server.url, **CLIENT) as client:
        for method, path in routes(server):
            assert (ask(client, method, path).status_code == 401) == (method != "get"), (method, path)
            expected = 200 if path in OPEN else 401
            assert ask(client, method, path, REFUSED["bearer"]).status_code == expected, (method, path)


def test_without_a_token_nothing_is_changed(home):
    with serve(home, token=None) as server, httpx.Client(base_url=server.url, **CLIENT) as client:
        for method, path in routes(server):
            answer = ask(client, method, path)
            assert (answer.status_code == 403) == (method != "get"), (method, path)
        for method in ("post", "put", "delete", "patch", "trace", "propfind"):
            answer = ask(client, method, "/v1/runs/old/stop", RIGHT)
            assert (answer.status_code, answer.json()["type"]) == (403, "urn:tandem:read-only")
    assert not (home / "runs" / "old" / "stop").exists()


def test_a_public_service_without_a_token_does_not_start(home):
    with pytest.raises(StatusError, match=r"^no token, .*TANDEM_TOKEN.*--token-file"):
        serve(home, token=None, host="0.0.0.0")


@pytest.mark.parametrize("token", ["short", "has spaces in its midst", "\u00e9" * 20])
def test_invalid_tokens(home, token):
    with pytest.raises(StatusError) as error:
        serve(home, token=token)
    assert token not in str(error.value)


@pytest.mark.parametrize(
    "host", ["evil.example:80", "127.0.0.1.evil.example", "10.0.0.1", "", "[::2]", "[::1].evil", "localhost@evil"]
)
def test_on_loopback_other_host_names_are_refused(server, host):
    with httpx.Client(base_url=server.url, **CLIENT) as client:
        answer = client.get("/v1/runs", headers={"Host": host, "Authorization": RIGHT})
    assert (answer.status_code, answer.json()["type"]) == (421, "urn:tandem:wrong-host")


@pytest.mark.parametrize("host", ["localhost", "localhost:1", "LOCALHOST", "127.0.0.1:8321", "127.9.9.9", "[::1]:8321"])
def test_loopback_host_names_are_accepted(server, host):
    with httpx.Client(base_url=server.url, **CLIENT) as client:
        assert client.get("/v1/runs", headers={"Host": host}).status_code == 200


def test_a_public_service_accepts_any_host_name(public):
    _, client = public
    assert client.get("/v1/runs", headers={"Host": "lab.example", "Authorization": RIGHT}).status_code == 200


def test_the_reason_for_not_ready_needs_the_token(tmp_path):
    (tmp_path / "runs").mkdir()
    with serve(tmp_path, host="0.0.0.0") as server, httpx.Client(base_url=server.url, **CLIENT) as client:
        (tmp_path / "runs").rmdir()
        anyone, trusted = (client.get("/readyz", headers=headers) for headers in ({}, {"Authorization": RIGHT}))
    assert anyone.status_code == trusted.status_code == 503
    assert str(tmp_path) in trusted.json()["detail"]
    assert str(tmp_path) not in anyone.text
    assert anyone.headers["retry-after"] == "5"
