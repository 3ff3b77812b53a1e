"""Ranges and entity tags of videos and blobs."""

import errno
import hashlib
import os

import pytest

from service.registry.registry import Registry
from service.status import app, files
from service.status.files import find_file, run_files
from service.store.disk_reader import DiskReader
from tests.status.runs import VIDEO

URL = "/v1/runs/old/video"


@pytest.mark.parametrize(
    ("asked", "start", "end"),
    [
        ("bytes=0-9", 0, 10),
        ("bytes=100-", 100, len(VIDEO)),
        ("bytes=-7", len(VIDEO) - 7, len(VIDEO)),
        ("bytes=0-99999999", 0, len(VIDEO)),
        (f"bytes=-{len(VIDEO) + 5}", 0, len(VIDEO)),
        (f"bytes={len(VIDEO) - 1}-", len(VIDEO) - 1, len(VIDEO)),
    ],
)
def test_a_range(client, asked, start, end):
    answer = client.get(URL, headers={"Range": asked})
    assert answer.status_code == 206
    assert answer.content == VIDEO[start:end]
    assert answer.headers["content-range"] == f"bytes {start}-{end - 1}/{len(VIDEO)}"


@pytest.mark.parametrize(
    "asked",
    [f"bytes={len(VIDEO)}-", f"bytes={10**17}-{10**17}", f"bytes={10**19}-", "bytes=-0", "bytes=88888-,99999-99999"],
)
def test_a_range_beyond_the_file(client, asked):
    answer = client.get(URL, headers={"Range": asked})
    assert (answer.status_code, answer.json()["type"]) == (416, "urn:tandem:no-such-range")
    assert answer.headers["content-range"] == f"bytes */{len(VIDEO)}"


def test_a_range_of_which_a_part_is_there_gives_the_file(client):
    answer = client.get(URL, headers={"Range": "bytes=0-1,99999-99999"})
    assert (answer.status_code, answer.content) == (200, VIDEO)


@pytest.mark.parametrize("asked", ["bytes=abc", "bytes=5-2", "items=0-1", "bytes", "bytes=", "bytes=0-1,x", "bytes=-"])
def test_a_range_that_is_none_does_not_count(client, asked):
    answer = client.get(URL, headers={"Range": asked})
    assert (answer.status_code, answer.content) == (200, VIDEO)


def test_several_ranges(client):
    answer = client.get(URL, headers={"Range": "bytes=0-1, 500-501"})
    assert answer.status_code == 206
    assert answer.headers["content-type"].startswith("multipart/byteranges")


def test_a_file_that_may_not_be_read(client, monkeypatch):
    def refused(path, *_, **__):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))

    monkeypatch.setattr(files, "open_regular", refused)  # root may read everything
    answer = client.get(URL)
    assert (answer.status_code, answer.json()["type"]) == (404, "urn:tandem:no-such-file")
    assert "Permission denied" in answer.json()["detail"]


def test_pictures_of_a_studys_run(tmp_path):
    run = tmp_path / "night" / "seed-3"
    run.mkdir(parents=True)
    for path in (run.parent / "study.json", run / "config.yaml", run / "curves.png"):
        path.write_bytes(b"-")
    directory = DiskReader(tmp_path).directory("night-seed-3")
    (found,) = run_files(directory, "night-seed-3")
    assert (found.name, found.num_bytes) == ("curves.png", 1)
    assert find_file(directory, "night-seed-3", "curves.png") == run / "curves.png"
    assert DiskReader(tmp_path).directory("seed-3") is None
    assert run_files(None, "seed-3") == []


def test_not_changed(client):
    first = client.get(URL)
    assert (first.headers["content-type"], first.headers["accept-ranges"]) == ("video/mp4", "bytes")
    tag = first.headers["etag"]
    for given in (tag, f"W/{tag}", f'"other", {tag}'):
        answer = client.get(URL, headers={"If-None-Match": given})
        assert (answer.status_code, answer.content, answer.headers["etag"]) == (304, b"", tag)
    assert client.get(URL, headers={"If-None-Match": '"other"'}).content == VIDEO


def test_a_conditional_request_for_a_range(client):
    """The entity tag counts before the range (RFC 9110, section 13.2.2)."""
    tag = client.get(URL).headers["etag"]
    answer = client.get(URL, headers={"If-None-Match": tag, "Range": f"bytes={len(VIDEO)}-"})
    assert (answer.status_code, answer.content) == (304, b"")


@pytest.mark.parametrize("path", ["/", "/page/index.html", "/page/main.js"])
def test_the_page_is_revalidated(client, path):
    first = client.get(path)
    assert (first.status_code, first.headers["cache-control"]) == (200, "no-cache")
    again = client.get(path, headers={"If-None-Match": first.headers["etag"]})
    assert (again.status_code, again.content, again.headers["cache-control"]) == (304, b"", "no-cache")


def test_a_range_of_a_file_that_changed_meanwhile(client, home):
    tag = client.get(URL).headers["etag"]
    ranged = {"Range": "bytes=5-9", "If-Range": tag}
    assert client.get(URL, headers=ranged).content == VIDEO[5:10]
    beyond = client.get(URL, headers=ranged | {"Range": f"bytes={len(VIDEO)}-"})
    assert (beyond.status_code, beyond.content) == (200, VIDEO)
    (home / "runs" / "old" / "rounds.mp4").write_bytes(VIDEO[::-1] + b"more")
    answer = client.get(URL, headers=ranged)
    assert (answer.status_code, answer.content) == (200, VIDEO[::-1] + b"more")
    (home / "runs" / "old" / "rounds.mp4").write_bytes(VIDEO)


def test_a_blob(client, home):
    manifest = Registry(home / "registry").manifest("tiny@champion")
    url = f"/v1/blobs/sha256/{manifest.blob_sha256}"
    answer = client.get(url)
    assert hashlib.sha256(answer.content).hexdigest() == manifest.blob_sha256
    assert len(answer.content) == manifest.blob_bytes
    assert answer.headers["etag"] == f'"{manifest.blob_sha256}"'
    assert "immutable" in answer.headers["cache-control"]
    assert client.get(url, headers={"If-None-Match": answer.headers["etag"]}).status_code == 304
    part = client.get(url, headers={"Range": "bytes=8-15"})
    assert (part.status_code, part.content) == (206, answer.content[8:16])


def test_curves_without_their_library_say_what_to_install(client, monkeypatch):
    monkeypatch.setattr(app, "find_spec", lambda name: None)
    answer = client.get("/page/plotly.js")
    assert (answer.status_code, answer.json()["type"]) == (404, "urn:tandem:no-plotly")
    assert "pip install 'tandem-skills[serve]'" in answer.json()["detail"]
