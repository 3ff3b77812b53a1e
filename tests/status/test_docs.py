"""docs/api.md: every curl in it is run, and its errors and events are complete."""

import json
import os
import re
import shutil
import subprocess
from pathlib import Path

import pytest
from fastapi import routing

from service.registry.registry import Registry
from service.status import auth, server, stream
from service.status.schemas import VersionSummary
from service.status.stream import EVENT_SCHEMA
from tests.status.conftest import serve
from tests.status.runs import TOKEN, VIDEO, append, grid, publish, record, write_status

ROOT = Path(__file__).parents[2]
TEXT = (ROOT / "docs" / "api.md").read_text()
NGINX = (ROOT / "deploy" / "nginx" / "nginx.conf").read_text()


def commands():
    """The commands after "$ " in the examples, with continued lines joined."""
    blocks = re.findall(r"```console\n(.*?)```", TEXT, re.DOTALL)
    return [found for block in blocks for found in re.findall(r"^\$ ((?:.*\\\n)*.*)$", block, re.MULTILINE)]


@pytest.fixture(scope="module")
def environment(tmp_path_factory):
    home = tmp_path_factory.mktemp("docs")
    write_status(home / "runs", "cube", state="finished")
    append(home / "runs", "cube", record(331), record(332))
    (home / "runs" / "cube" / "goals.json").write_text(grid().model_dump_json())
    (home / "runs" / "cube" / "rounds.mp4").write_bytes(VIDEO)
    publish(Registry(home / "registry"), "panda-cube")
    Registry(home / "registry").set_alias("panda-cube", "champion", 1)
    with serve(home) as server:
        yield {**os.environ, "TANDEM_URL": server.url, "TANDEM_TOKEN": TOKEN, "no_proxy": "*"}


@pytest.mark.skipif(shutil.which("curl") is None, reason="the documents' examples call curl, which is not on PATH")
@pytest.mark.parametrize("command", commands())
def test_examples(environment, tmp_path, command):
    checked = command.replace("curl ", "curl --fail-with-body --max-time 300 ", 1)
    result = subprocess.run(
        ["sh", "-c", checked], env=environment, cwd=tmp_path, capture_output=True, text=True, timeout=600, check=False
    )
    if command.endswith('/nope"'):
        assert (result.returncode, json.loads(result.stdout)["type"]) == (22, "urn:tandem:unknown-run")
        return
    assert result.returncode == 0, result.stdout + result.stderr
    if "-o rounds.mp4" in command:
        assert (tmp_path / "rounds.mp4").read_bytes() == VIDEO
    elif "-o metrics.csv" in command:
        assert (tmp_path / "metrics.csv").read_text().startswith("run,iteration,env_steps,bob/success_rate\ncube,331,")
    elif "/stream" in command:
        assert "event: metrics\n" in result.stdout
        assert "event: end\n" in result.stdout
    else:
        assert json.loads(result.stdout)


def test_there_are_examples():
    assert len(commands()) >= 12


def test_every_kind_of_problem_is_listed():
    sources = [path.read_text() for path in (ROOT / "service" / "status").glob("*.py")]
    kinds = {kind for text in sources for kind in re.findall(r"(?:ProblemError\(\s*|, )\d{3}, \"([a-z-]+)\"", text)}
    assert {"unknown-run", "no-such-range", "read-only", "damaged"} <= kinds
    table = TEXT[TEXT.index("## Errors") : TEXT.index("## The client")]
    assert {kind for kind in kinds if f"`{kind}`" not in table} == set()


def test_the_version_that_is_shown_has_the_fields_of_one():
    (shown,) = re.findall(r'"versions":\[\s(\{.*?\})\]\}', TEXT, re.DOTALL)
    assert set(re.findall(r'"(\w+)":', shown)) == set(VersionSummary.model_fields)


def test_every_event_is_listed():
    assert [kind for kind in EVENT_SCHEMA["properties"]["event"]["enum"] if f"| `{kind}` |" not in TEXT] == []


def test_numbers():
    assert f"more than {auth.MAX_BODY_BYTES // 1024} KiB" in TEXT
    assert f"{server.MAX_HEAD_BYTES // 1024} KiB of headers, {server.MAX_CONNECTIONS} connections" in TEXT
    assert f"At most {stream.MAX_STREAMS} streams" in TEXT
    assert stream.MAX_AGE_S == 3600.0
    assert "ends\nafter an hour" in TEXT
    assert f"After {routing._PING_INTERVAL:g} seconds without an event" in TEXT


def test_who_covers_what():
    """The table of attacks: what the service alone does against them, and what nginx does with the deployed file."""

    def number(name):
        return int(re.search(rf"\b{name}[ =](\d+)", NGINX)[1])

    table = (ROOT / "docs" / "operations.md").read_text().split("\n### Who covers what\n\n")[1].split("\n\n")[0]
    rows = dict(re.findall(r"^\| (.+?) \| (.+ \| .+) \|$", table, re.MULTILINE))
    bare = {what: cells.split(" | ")[0] for what, cells in rows.items()}
    behind = {what: cells.split(" | ")[1] for what, cells in rows.items()}
    half, unread = "clients that send half a head or half a body", "clients that read nothing"
    assert [what for what, cell in bare.items() if "**not covered**" in cell] == [half, unread, "listening in"]
    assert number("client_header_timeout") == number("client_body_timeout")
    assert behind[half].startswith(f"ended after {number('client_body_timeout')} s")
    assert behind[unread].startswith(f"ended after {number('send_timeout')} s")
    assert server.MAX_HEAD_BYTES == auth.MAX_BODY_BYTES
    assert bare["long headers and bodies"] == f"about {server.MAX_HEAD_BYTES // 1024} KiB each"
    sizes = 4 * number("large_client_header_buffers 4"), number("client_max_body_size")
    assert behind["long headers and bodies"] == "{} KiB and {} KiB".format(*sizes)
    assert bare["many connections"].startswith(f"{server.MAX_CONNECTIONS}, then 503")
    assert behind["many connections"].startswith(f"{number('limit_conn connections')} from an address")
    rate = f"at most {number('rate')} a second from an address, in bursts of {number('burst')}"
    assert behind["requests faster than their answers are read"] == rate
