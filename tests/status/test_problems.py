"""Errors: one format, one line that says what to do, and no internals."""

import json
import logging
import socket

import httpx
import pytest

from service.registry.registry import Registry
from service.status.auth import MAX_BODY_BYTES
from service.status.server import StatusServer
from service.store.disk_reader import DiskReader
from tests.status.conftest import serve
from tests.status.runs import BEARER, CLIENT, publish, write_runs

JSON = {"Content-Type": "application/json"}


def assert_problem(answer, status, kind, *parts):
    """Check that an answer is a problem (RFC 9457) whose one-line detail has these parts."""
    assert answer.status_code == status
    assert answer.headers["content-type"] == "application/problem+json"
    problem = answer.json()
    assert (problem["status"], problem["type"]) == (status, kind if ":" in kind else f"urn:tandem:{kind}")
    assert problem["title"]
    assert ("errors" in problem) == problem["type"].endswith(":invalid-request")
    assert "\n" not in problem["detail"]
    for part in parts:
        assert part in problem["detail"]


@pytest.mark.parametrize(
    ("method", "path", "status", "kind", "parts"),
    [
        ("GET", "/nope", 404, "about:blank", ["'/nope'", "/openapi.json"]),
        ("GET", "/v1/runs/", 404, "about:blank", []),
        ("GET", "/page/nope.js", 404, "about:blank", []),
        ("GET", "/page/%2e%2e/app.py", 404, "about:blank", []),
        ("GET", "/v1/runs/nope", 404, "unknown-run", ["'nope'", "cube, old"]),
        ("GET", "/v1/runs/nope/metrics/stream", 404, "unknown-run", []),
        ("GET", "/v1/runs/nope/goals", 404, "unknown-run", []),
        ("GET", "/v1/runs/nope/video", 404, "unknown-run", []),
        ("POST", "/v1/runs/nope/stop", 404, "unknown-run", []),
        ("GET", "/v1/runs/-bad-", 422, "invalid-request", ["path.run_id"]),
        ("GET", "/v1/runs?limit=0", 422, "invalid-request", ["query.limit", "'0'"]),
        ("GET", "/v1/runs?active=perhaps", 422, "invalid-request", ["query.active", "'perhaps'"]),
        ("GET", "/v1/runs/old/metrics?max_points=x", 422, "invalid-request", ["query.max_points", "'x'"]),
        ("GET", "/v1/runs/old/metrics?after_iteration=-1", 422, "invalid-request", ["query.after_iteration"]),
        ("GET", f"/v1/runs/old/metrics?after_iteration={10**30}", 422, "invalid-request", ["query.after_iteration"]),
        ("GET", f"/v1/runs/old/metrics?names={'x' * 129}", 422, "invalid-request", ["query.names.0"]),
        ("GET", "/v1/primitives/nope", 404, "unknown-version", ["'nope'", "tiny"]),
        ("GET", "/v1/primitives/tiny/versions/9", 404, "unknown-version", ["9", "1 to 2"]),
        ("GET", "/v1/primitives/tiny/versions/best", 404, "unknown-version", ["'best'", "champion -> 1"]),
        ("GET", "/v1/primitives/Tiny", 422, "invalid-request", ["path.name", "'Tiny'"]),
        ("GET", f"/v1/blobs/sha256/{'0' * 64}", 404, "unknown-blob", ["0" * 64]),
        ("GET", "/v1/blobs/sha256/nope", 422, "invalid-request", ["path.digest"]),
        ("DELETE", "/v1/runs", 405, "about:blank", ["'DELETE'"]),
        ("GET", "/v1/runs/old/stop", 405, "about:blank", ["'GET'"]),
        ("POST", "/page/index.html", 405, "about:blank", ["'POST'"]),
        ("PUT", "/v1/primitives/tiny/aliases/7", 422, "invalid-request", ["path.alias"]),
    ],
)
def test_problems(client, method, path, status, kind, parts):
    answer = client.request(method, path, json={"version": 1} if method == "PUT" else None)
    assert_problem(answer, status, kind, *parts)
    assert ("allow" in answer.headers) == (status == 405)


@pytest.mark.parametrize(
    ("body", "part"),
    [
        (b"", "body"),
        (b"{", "JSON"),
        (b"\xff\xfe", "body"),
        (b"{}", "body.version"),
        (b'{"version": "one"}', "body.version"),
        (b'{"version": 1e400}', "body.version"),
        (b'{"version": 1, "more": 2}', "body.more"),
        (b"[" * 30_000, "body"),
    ],
)
def test_malformed_bodies(client, home, body, part):
    answer = client.put("/v1/primitives/tiny/aliases/champion", content=body, headers=JSON)
    assert answer.status_code in (400, 422)
    assert_problem(answer, answer.status_code, answer.json()["type"])
    assert part in answer.text or answer.status_code == 400
    assert Registry(home / "registry").aliases("tiny")["champion"] == 1


def test_bodies_may_not_be_long(client):
    def chunks():
        for _ in range(9):
            yield b" " * (MAX_BODY_BYTES // 8)

    for body in (b" " * (MAX_BODY_BYTES + 1), chunks()):  # the second does not say how long it is
        answer = client.put("/v1/primitives/tiny/aliases/best", content=body)
        assert_problem(answer, 413, "about:blank", str(MAX_BODY_BYTES))


def test_a_body_as_long_as_it_may_be(client):
    body = json.dumps({"version": 9}).encode().ljust(MAX_BODY_BYTES)
    assert_problem(client.put("/v1/primitives/tiny/aliases/best", content=body, headers=JSON), 404, "unknown-version")


def test_a_long_body_that_nothing_asks_for_is_not_waited_for(server):
    head = f"POST /v1/runs/old/stop HTTP/1.1\r\nHost: localhost\r\nAuthorization: {BEARER['Authorization']}\r\n"
    with socket.create_connection(("127.0.0.1", server.port), timeout=300) as connection:
        connection.sendall(f"{head}Content-Length: {10**15}\r\n\r\n".encode())
        assert connection.recv(1000).startswith(b"HTTP/1.1 202")


def test_the_store_is_away_and_back(tmp_path):
    write_runs(tmp_path / "runs")
    with serve(tmp_path) as server, httpx.Client(base_url=server.url, headers=BEARER, **CLIENT) as client:
        (tmp_path / "runs").rename(tmp_path / "elsewhere")
        for path in (
            "/v1/runs",
            "/v1/runs/old",
            "/v1/runs/old/metrics",
            "/v1/runs/old/metrics/stream",
            "/v1/runs/old/video",
        ):
            answer = client.get(path)
            assert_problem(answer, 503, "store-unavailable", str(tmp_path / "runs"))
            assert answer.headers["retry-after"] == "5"
        assert_problem(client.get("/readyz"), 503, "not-ready", str(tmp_path / "runs"))
        assert client.get("/livez").status_code == 200
        (tmp_path / "elsewhere").rename(tmp_path / "runs")
        assert client.get("/readyz").status_code == client.get("/v1/runs/old").status_code == 200


def test_damaged_files(tmp_path):
    write_runs(tmp_path / "runs")
    registry = Registry(tmp_path / "registry")
    publish(registry)
    digest = registry.manifest("tiny@1").blob_sha256
    (tmp_path / "runs" / "cube" / "goals.json").write_text("{}")
    with serve(tmp_path) as server, httpx.Client(base_url=server.url, headers=BEARER, **CLIENT) as client:
        assert_problem(client.get("/v1/runs/cube/goals"), 500, "damaged", "goals.json")
        assert client.get(f"/v1/blobs/sha256/{digest}").status_code == 200
        blob = tmp_path / "registry" / "blobs" / "sha256" / digest
        blob.write_bytes(bytes([blob.read_bytes()[0] ^ 1]) + blob.read_bytes()[1:])
        assert_problem(client.get(f"/v1/blobs/sha256/{digest}"), 500, "damaged", digest)
        (tmp_path / "registry" / "models" / "tiny" / "aliases" / "latest").write_text("two")
        assert_problem(client.get("/v1/primitives/tiny"), 500, "failed", "latest", "damaged")
        listed = {each["name"]: each["aliases"] for each in client.get("/v1/primitives").json()["primitives"]}
        assert listed["tiny"] == {}
        assert "champion" in listed["panda-cube"]


def test_a_run_that_cannot_be_read_hides_no_other(tmp_path):
    write_runs(tmp_path / "runs")
    with (tmp_path / "runs" / "old" / "metrics.jsonl").open("a") as records:
        records.write("[" * 1000 + "]" * 1000 + "\n")
    (tmp_path / "runs" / "loop").symlink_to("loop")
    with serve(tmp_path) as server, httpx.Client(base_url=server.url, headers=BEARER, **CLIENT) as client:
        assert client.get("/v1/runs/old/metrics").json()["iteration"] == [1, 2, 3]
        runs = {run["run_id"]: run for run in client.get("/v1/runs?sparkline=bob/success_rate").json()["runs"]}
        assert {client.get(f"/v1/runs/{name}").status_code for name in runs} == {200}
        metrics = client.get("/metrics")
    assert runs.keys() == {"cube", "old", "loop"}
    assert (runs["cube"]["warnings"], runs["cube"]["last_error"]) == ([], None)
    assert "passed over: 1" in runs["old"]["warnings"][0]
    assert "symbolic links" in runs["loop"]["last_error"]
    assert metrics.status_code == 200
    assert 'tandem_run_iteration{run="cube"} 3.0' in metrics.text


class BrokenReader(DiskReader):
    """A reader with a bug."""

    def runs(self):
        raise ZeroDivisionError("a secret of its own")


def test_an_unexpected_error_is_only_in_the_log(tmp_path, caplog):
    caplog.set_level(logging.ERROR)
    with StatusServer(BrokenReader(tmp_path), Registry(tmp_path / "registry"), port=0) as server:
        answer = httpx.get(f"{server.url}/v1/runs", **CLIENT)
    assert_problem(answer, 500, "failed", "unforeseen")
    assert answer.headers["x-content-type-options"] == "nosniff"
    assert "secret" not in answer.text
    assert "Traceback" not in answer.text
    (logged,) = caplog.records
    assert logged.getMessage() == "GET /v1/runs failed"
    assert logged.exc_info is not None
