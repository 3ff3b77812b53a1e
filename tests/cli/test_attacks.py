"""What anybody may have put where a command expects a file: one line, an exit code, no traceback, no waiting.

To add an attack, add a line to ``NOT_FILES`` or ``NO_CONTENT``; to add a place that is attacked, one to ``PLACES``.
"""

import os
import pickle
import shutil
import signal
from contextlib import contextmanager
from itertools import pairwise

import pytest

from service.registry.publishing import publish
from service.registry.registry import Registry
from tests.cli.typed import tandem
from tests.runs.runs import begin_study, play, tiny_config, write_yaml

LIMIT_S = 60
"""Far more than any refusal takes, and far less than forever."""


def a_billion_laughs():
    names = "abcdefghij"
    lines = ["a: &a [x, x, x, x, x, x, x, x, x]"]
    lines += [f"{each}: &{each} [{', '.join(['*' + last] * 9)}]" for last, each in pairwise(names)]
    return "\n".join(lines).encode()


NOT_FILES = {
    "fifo": os.mkfifo,
    "directory": os.mkdir,
    "endless device": lambda path: path.symlink_to("/dev/zero"),
}
NO_CONTENT = {
    "noise": b"\x93\xff\x00noise" * 20,
    "pickle": pickle.dumps({"weight": [1.0]}),
    "brackets, a hundred thousand deep": b"[" * 100_000,
    "billion laughs": a_billion_laughs(),
    "list within itself": b"&a [*a, *a]",
    "tag of a Python object": b"!!python/object/apply:os.system [id]",
    "5000 digits": b"9" * 5000,
    "greater than any float": b'{"version": 1e999, "seeds": [1e999], "seed": 1e999}',
    "half a character": b'{"name": "\\ud800", "version": "\\ud800", "seeds": ["\\ud800"]}',
    "wrong types": b'{"version": [1], "seeds": "x", "name": {"a": 1}, "format_version": 1, "run": 4, "cell": 3}',
    "nothing": b"",
    "lines for a terminal": b'name: "x\\nTraceback (most recent call last):\\n\\e[2J"',
}
EVALUATE = ("evaluate", "--episodes", "2", "--steps", "2", "--registry", "registry")
RESUME = ("pretrain", "--resume", "--registry", "registry", "--run-dir")
CHECKPOINT = "run/checkpoints/*"
VERSION, BLOB = "registry/models/tiny/versions/1", "registry/blobs/*/*"
PLACES = {
    "--config": ("tiny.yaml", ("pretrain", "--config", "tiny.yaml", "--run-dir", "new")),
    "--config of a resume": ("tiny.yaml", (*RESUME, "run", "--config", "tiny.yaml")),
    "config.yaml": ("run/config.yaml", (*RESUME, "run")),
    "checkpoint": (CHECKPOINT, (*RESUME, "run")),
    "published.json": ("run/published.json", (*RESUME, "run")),
    "run.json": ("run/run.json", (*RESUME, "run")),
    "study's config": ("study/seed-1.yaml", (*RESUME, "study", "--seeds", "0,1")),
    "study.json": ("study/study.json", (*RESUME, "study", "--seeds", "0,1")),
    "manifest": (VERSION, (*EVALUATE, "tiny")),
    "manifest to verify": (VERSION, ("registry", "verify", "--registry", "registry")),
    "blob": (BLOB, (*EVALUATE, "tiny")),
    "blob to verify": (BLOB, ("registry", "verify", "--registry", "registry")),
    "checkpoint to publish": (CHECKPOINT, ("publish", "run", "--registry", "registry")),
}


@contextmanager
def soon():
    """Fail where the block waits for something that never comes."""

    before = signal.signal(signal.SIGALRM, lambda *which: pytest.fail(f"not within {LIMIT_S} s"))
    signal.alarm(LIMIT_S)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


def refuse(arguments):
    """Run a command that has to end with one line; returns it."""
    with soon():
        result = tandem(*arguments)
    assert result.exit_code == (1 if "verify" in arguments else 2), (result.stderr, result.exception)
    assert result.stderr.count("\n") == 1, result.stderr
    assert result.stderr.endswith("\n")
    assert "Traceback (" not in result.stderr.replace("\\nTraceback", "")
    assert "unexpected" not in result.stderr
    assert result.stderr[:-1].isprintable()
    return result.stderr


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    """A run, what it published and a study, all of them small."""
    home = tmp_path_factory.mktemp("good")
    config = tiny_config(keep_checkpoints=1)
    run, _ = play(home / "run", config)
    write_yaml(home / "tiny.yaml", config.model_dump(mode="json"))
    registry = Registry(home / "registry")
    publish(registry, config, run.method.parameters(), {"env_steps": 600.0})
    begin_study(home / "study", config)
    return home


@pytest.fixture
def home(good, tmp_path, monkeypatch):
    """A copy of all that, as the directory that commands run in."""
    shutil.copytree(good, tmp_path / "home", symlinks=True)
    monkeypatch.chdir(tmp_path / "home")
    return tmp_path / "home"


def take_away(home, file):
    """Make room for something else in the place of a file; returns its path."""
    (path,) = list(home.glob(file)) or [home / file]
    path.unlink(missing_ok=True)
    return path


@pytest.mark.parametrize("place", PLACES)
def test_what_is_no_file(home, place):
    file, arguments = PLACES[place]
    path = take_away(home, file)
    for make in NOT_FILES.values():
        make(path)
        assert path.name in refuse(arguments)
        (path.rmdir if path.is_dir() else path.unlink)()


@pytest.mark.parametrize("place", PLACES)
def test_a_file_with_something_else_in_it(home, place):
    file, arguments = PLACES[place]
    path = take_away(home, file)
    for name, content in NO_CONTENT.items():
        path.write_bytes(content)
        said = refuse(arguments)
        assert path.name in said or (file.startswith("registry") and "tiny" in said), (name, said)
    with path.open("wb") as huge:
        huge.truncate(1 << 36)  # without a block on the disk
    assert path.name in refuse(arguments)


NOT_UTF8 = os.fsdecode(b"\xb2")
PRETRAIN = ("pretrain", "--config", "tiny.yaml", "--registry", "new", "--set", "run.total_env_steps=200")
TYPED = {
    "no id": ((*PRETRAIN, "--run-id", ""), "--run-id: an argument is empty"),
    "no command": (("",), "the first word: an argument is empty"),
    "no directory": ((*PRETRAIN, "--run-dir", ""), "--run-dir: an argument is empty"),
    "an id that leads out": ((*PRETRAIN, "--run-id", "../../etc"), "--run-id '../../etc': use 1 to 128 letters"),
    "an id with a line end": ((*PRETRAIN, "--run-id", "x\n"), "--run-id 'x\\n'"),
    "true as a number": ((*PRETRAIN, "--run-dir", "new", "--set", "game.num_worlds=true"), "expected a number"),
    "a lock that is a link": ((*PRETRAIN, "--run-dir", "locked"), "locked/.lock: a symbolic link"),
    "a host that is no text": (("serve", "--runs", ".", "--host", NOT_UTF8), "is no name of a host"),
    "a file as registry": (("registry", "list", "--registry", "tiny.yaml"), "tiny.yaml is no directory"),
    "a token from a FIFO": (("serve", "--runs", ".", "--token-file", "fifo"), "--token-file fifo: not a regular file"),
    "a token from a device": (("serve", "--runs", ".", "--token-file", "/dev/zero"), "/dev/zero: not a regular file"),
    "a token that never ends": (("serve", "--runs", ".", "--token-file", "huge"), "huge: longer than 4096 bytes"),
}  # fmt: skip


def content_of(home):
    """Every path with its size, time, and where it leads; a file is not read, for it may be huge."""
    return {path: (path.lstat().st_mtime_ns, path.lstat().st_size, path.is_symlink()) for path in home.rglob("*")}


@pytest.mark.parametrize("what", TYPED)
def test_what_is_typed_wrongly_is_one_line_and_overwrites_nothing(home, what):
    (home / "locked").mkdir()
    (home / "locked" / ".lock").symlink_to("../tiny.yaml")
    os.mkfifo(home / "fifo")
    with (home / "huge").open("wb") as huge:
        huge.truncate(1 << 36)
    before = content_of(home.parent)
    arguments, part = TYPED[what]
    assert part in refuse(arguments)
    assert content_of(home.parent) == before
