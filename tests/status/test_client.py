"""Primitives over HTTP, from real services, correct and faulty ones."""

import os
import subprocess
import sys
import threading
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
import pytest

import service
from service.base.errors import (
    DamagedBlobError,
    FetchError,
    StatusError,
    StorageError,
    TandemError,
    UnknownVersionError,
    WrongTokenError,
)
from service.registry.bundled import BUNDLED
from service.registry.client import fetch_primitives
from service.registry.registry import Registry
from service.status.server import StatusServer
from service.store.disk_reader import DiskReader
from tests.registry.helpers import files_in
from tests.runs.runs import assert_one_line
from tests.status.conftest import serve
from tests.status.runs import TOKEN, WRONG, publish

ROOT = Path(__file__).parents[2]
LOAD = """
import sys
import service
assert not {"httpx", "fastapi", "numpy"} & set(sys.modules)
bob = service.load("panda-cube@champion", registry=sys.argv[1])
assert not {"torch", "fastapi", "uvicorn"} & set(sys.modules)
print(bob.label)
"""


@pytest.fixture(autouse=True)
def no_token(monkeypatch, tmp_path):
    """Remove the variables of the environment that the client reads."""
    for name in ("TANDEM_TOKEN", "TANDEM_URL", "TANDEM_REGISTRY", "HTTP_PROXY", "http_proxy", "ALL_PROXY", "all_proxy"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))


@contextmanager
def answering(answers, record=None):
    """Run a server that gives fixed answers (status, content type, body) by path; yield its URL."""

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self):
            status, kind, body = answers.get(self.path, (404, "text/html", b"<h1>not here</h1>"))
            if record is not None:
                record.append(self.path)
            self.send_response(status)
            self.send_header("Content-Type", kind)
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, *_):
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_port}"
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


@pytest.fixture
def published(tmp_path):
    """The answers of a service with one version, by path."""
    registry = Registry(tmp_path / "published")
    publish(registry, value=1.0)
    manifest = registry.manifest("tiny@1")
    blob = (registry.root / "blobs" / "sha256" / manifest.blob_sha256).read_bytes()
    return {
        "/v1/primitives/tiny/versions/1": (200, "application/json", manifest.to_bytes()),
        "/v1/primitives/tiny/versions/latest": (200, "application/json", manifest.to_bytes()),
        f"/v1/blobs/sha256/{manifest.blob_sha256}": (200, "application/octet-stream", blob),
    }


def blob_path(answers):
    return next(path for path in answers if "blobs" in path)


@pytest.mark.parametrize(("reference", "number"), [("tiny", 2), ("tiny@champion", 1)])
def test_a_fetched_version_is_complete(server, home, tmp_path, reference, number):
    registry, version = fetch_primitives(server.url, reference)
    assert version == ("tiny", number)
    own = Registry(home / "registry")
    assert registry.manifest(str(version)) == own.manifest(f"tiny@{number}")
    assert np.array_equal(registry.load(str(version))[1]["gate.weight"], np.full((2, 3), number, np.float32))
    assert registry.verify() == []
    assert registry.root.is_relative_to(tmp_path)


def test_parameters_are_fetched_once_and_aliases_are_asked_for_each_time(published, tmp_path):
    asked = []
    with answering(published, asked) as url:
        for _ in range(2):
            fetch_primitives(url + "/", "tiny")
    manifest = "/v1/primitives/tiny/versions/latest"
    assert asked == [manifest, blob_path(published), manifest]


def test_a_damaged_cache_mends_itself(published, tmp_path):
    with answering(published) as url:
        registry, version = fetch_primitives(url, "tiny")
        (blob,) = (registry.root / "blobs" / "sha256").iterdir()
        blob.write_bytes(b"something else")
        fetch_primitives(url, "tiny")
    assert registry.verify(str(version)) == []


def test_two_services_have_two_caches(published, tmp_path):
    with answering(published) as first, answering(published) as second:
        registries = [fetch_primitives(url, "tiny")[0] for url in (first, second)]
    assert registries[0].root != registries[1].root


@pytest.mark.parametrize("length", [-1, 0])
def test_a_corrupted_blob_is_refused_and_nothing_is_kept(published, tmp_path, length):
    path = blob_path(published)
    status, kind, blob = published[path]
    published[path] = (status, kind, blob[:length])
    with answering(published) as url, pytest.raises(DamagedBlobError) as error:
        fetch_primitives(url, "tiny@1")
    assert_one_line(error.value, url.removeprefix("http://"))
    assert files_in(tmp_path / "xdg") == {}


def test_a_manifest_that_was_changed_in_transit(published, tmp_path):
    path = "/v1/primitives/tiny/versions/1"
    published[path] = (200, "application/json", published[path][2].replace(b'"seed": 3', b'"seed": 4'))
    with answering(published) as url, pytest.raises(DamagedBlobError) as error:
        fetch_primitives(url, "tiny@1")
    assert_one_line(error.value, "tiny@1", "manifest", "sha256")


def test_the_manifest_of_another_version(published, tmp_path):
    published["/v1/primitives/other/versions/1"] = published["/v1/primitives/tiny/versions/1"]
    published["/v1/primitives/tiny/versions/7"] = published["/v1/primitives/tiny/versions/1"]
    with answering(published) as url:
        for reference in ("other@1", "tiny@7"):
            with pytest.raises(DamagedBlobError) as error:
                fetch_primitives(url, reference)
            assert_one_line(error.value, "gave the manifest of tiny@1", f"for {reference}")


@pytest.mark.parametrize(
    ("reference", "parts"),
    [
        ("nope", ["'nope'", "it holds: tiny"]),
        ("tiny@9", ["no version 9", "1 to 2"]),
        ("tiny@best", ["'best'", "champion"]),
    ],
)
def test_unknown_versions(server, tmp_path, reference, parts):
    with pytest.raises(UnknownVersionError) as error:
        fetch_primitives(server.url, reference)
    assert_one_line(error.value, server.url, *parts)


def test_the_token(home, tmp_path, monkeypatch):
    with serve(home, host="0.0.0.0") as server:
        with pytest.raises(WrongTokenError) as error:
            fetch_primitives(server.url, "tiny")
        assert_one_line(error.value, server.url, "a token is needed", "TANDEM_TOKEN")
        monkeypatch.setenv("TANDEM_URL", server.url)
        monkeypatch.setenv("TANDEM_TOKEN", WRONG)
        with pytest.raises(WrongTokenError) as error:
            fetch_primitives(server.url, "tiny")
        assert_one_line(error.value, "wrong token")
        assert WRONG not in str(error.value)
        monkeypatch.setenv("TANDEM_TOKEN", TOKEN)
        monkeypatch.delenv("TANDEM_URL")
        for variable in ("TANDEM_URL", "TANDEM_REGISTRY"):
            with pytest.raises(WrongTokenError) as error:  # it may be anybody's URL
                fetch_primitives(server.url, "tiny")
            assert_one_line(error.value, "a token is needed", "TANDEM_URL to this URL")
            with monkeypatch.context() as configured:
                configured.setenv(variable, f"{server.url}/")
                assert fetch_primitives(server.url, "tiny")[1].number == 2


def test_no_service_at_the_url(home, tmp_path):
    server = serve(home)
    server.start()
    server.stop()
    with pytest.raises(FetchError) as error:
        fetch_primitives(server.url, "tiny")
    assert_one_line(error.value, f"cannot reach {server.url}", "refused", "tandem serve")


@pytest.mark.parametrize(
    ("answer", "part"),
    [
        ((200, "text/html", b"<h1>a router</h1>"), "not JSON"),
        ((404, "text/html", b"<h1>a router</h1>"), "404 and text/html"),
        ((302, "text/html", b""), "302"),
        ((500, "application/problem+json", b"{"), "500"),
        ((503, "application/problem+json", b'{"detail": "the store\\nis away"}'), "the store is away"),
        ((503, "application/problem+json", b'{"detail": "\\u001b]0;owned\\u0007"}'), r"\x1b]0;owned\x07"),
        ((503, "application/problem+json", b"[" * 60_000), "503"),
        ((503, "text/\x1b[2J", b""), "503"),
        ((200, "application/json", b"[" * 60_000), "nested more than 64 deep"),
        ((200, "application/json", b"[]"), "not a JSON object"),
    ],
)
def test_something_else_at_the_url(tmp_path, answer, part):
    with answering({"/v1/primitives/tiny/versions/1": answer}) as url, pytest.raises(TandemError) as error:
        fetch_primitives(url, "tiny@1")
    assert_one_line(error.value, part)
    assert str(error.value).isprintable()


@pytest.mark.parametrize("url", ["http://", "http://me:secret@host:1", "ftp://host", "http://host:port"])
def test_invalid_urls(tmp_path, url):
    with pytest.raises(StatusError) as error:
        fetch_primitives(url, "tiny")
    assert_one_line(error.value)
    assert "secret" not in str(error.value)


def test_a_cache_that_cannot_be_written(server, tmp_path):
    (tmp_path / "xdg").write_text("a file")
    with pytest.raises(StorageError, match=r"^cannot (read|write) .*xdg"):
        fetch_primitives(server.url, "tiny")


@pytest.fixture(scope="module")
def champions(tmp_path_factory):
    """A service of the bundled registry."""
    runs = tmp_path_factory.mktemp("runs")
    with StatusServer(DiskReader(runs), Registry(BUNDLED), port=0) as server:
        yield server


def test_loading_the_champion(champions):
    bob, own = service.load("panda-cube@champion", registry=champions.url), service.load()
    assert f"{bob.label} (bundled)" == own.label
    assert (bob.manifest, bob.config) == (own.manifest, own.config)
    rows = np.random.default_rng(0).standard_normal((5, 14)).astype(np.float32)
    assert np.array_equal(bob.primitives.act_deterministic(rows), own.primitives.act_deterministic(rows))
    assert list((Path(os.environ["XDG_CACHE_HOME"]) / "tandem" / "registries").iterdir())


def test_loading_imports_neither_torch_nor_the_service(champions, tmp_path):
    environment = {**os.environ, "XDG_CACHE_HOME": str(tmp_path)}
    result = subprocess.run(
        [sys.executable, "-c", LOAD, champions.url],
        cwd=ROOT,
        env=environment,
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert result.returncode == 0, result.stderr
    assert result.stdout.startswith("panda-cube@")
