"""The live world beside the demo, and ``tandem play`` of a run that goes on, without a browser."""

import os
import socket
from types import SimpleNamespace

import pytest

from service.cli import demo
from service.robot.play import following, server
from service.runs.signals import PARENT
from tests.cli.typed import tandem

STARTED = []


class Process:
    """In place of the one with the live world."""

    def __init__(self, command, *, env, **options):
        self.command, self.env, self.code, self.calls = command, env, None, []
        STARTED.append(self)

    def poll(self):
        return self.code

    def terminate(self):
        self.calls.append("terminate")

    def wait(self, timeout):
        self.calls.append("wait")

    def kill(self):
        self.calls.append("kill")


@pytest.fixture
def port():
    """A port at which something listens."""
    with socket.create_server(("127.0.0.1", 0)) as listening:
        yield listening.getsockname()[1]


@pytest.fixture
def told(port, monkeypatch):
    """What the person at the terminal was told."""
    said = []
    STARTED.clear()
    monkeypatch.setattr(demo.subprocess, "Popen", Process)
    monkeypatch.setattr(demo.importlib.util, "find_spec", lambda name: True)
    monkeypatch.setattr(demo, "free_port", lambda host, first: port)
    monkeypatch.setattr(demo, "answer", said.append)
    monkeypatch.setattr(demo.webbrowser, "open_new_tab", lambda url: None)
    return said


def test_the_address_of_the_live_world_is_told_once_and_it_ends_with_the_demo(told, port, tmp_path):
    url = f"http://127.0.0.1:{port}"
    with demo._watched(tmp_path / "demo-1", wanted=True) as look:
        assert not STARTED
        assert [look() for _ in range(3)] == ["", url, url]
        (process,) = STARTED
        assert process.calls == []
        process.code = 0
        assert look() == ""
    assert told == [f"watch it at {url}: drag the goal, and see whether Bob can"]
    assert process.calls == ["terminate", "wait", "kill"]
    assert process.env[PARENT] == str(os.getpid())


def test_a_live_world_that_cannot_be_is_told_once(told, monkeypatch, tmp_path):
    monkeypatch.setattr(demo.socket, "create_connection", refused)
    with demo._watched(tmp_path / "demo-1", wanted=True) as look:
        assert look() == ""
        assert told == []  # it may only take its time
        STARTED[0].code = 2
        assert [look(), look()] == ["", ""]
    assert told == [f"the live world ended; this says why: tandem play {tmp_path / 'demo-1'}"]


@pytest.mark.parametrize("wanted", [True, False])
def test_without_its_packages_or_unwanted_there_is_no_live_world(told, wanted, monkeypatch, tmp_path):
    monkeypatch.setattr(demo.importlib.util, "find_spec", lambda name: None)
    with demo._watched(tmp_path / "demo-1", wanted=wanted) as look:
        assert [look(), look()] == ["", ""]
    assert told == ["to watch it in the browser: pip install 'tandem-skills[play]'"] * wanted
    assert STARTED == []


@pytest.mark.parametrize("goes_on", [True, False])
def test_the_live_world_follows_a_run_that_goes_on(told, port, goes_on, monkeypatch, tmp_path):
    """By the very words with which the demo begins it."""
    with demo._watched(tmp_path / "demo-1", wanted=True) as look:
        look()
    monkeypatch.undo()
    words = STARTED[0].command
    made = []

    def live_world(players, host, port, seed, following):
        made.append((host, port, seed, following))
        return SimpleNamespace(url="http://here", port=port, run=lambda ended: None, close=lambda: None)

    follower = SimpleNamespace(close=lambda: made.append("closed"))
    monkeypatch.setattr(server, "LiveWorld", live_world)
    monkeypatch.setattr(following, "is_running", lambda path: goes_on)
    monkeypatch.setattr(following, "Following", lambda *given: follower)
    reference = "panda-cube@champion"
    words = [reference if word == str(tmp_path / "demo-1") else word for word in words[words.index("play") :]]
    assert tandem(*words).exit_code == 0
    assert made == ([("127.0.0.1", port, 0, follower), "closed"] if goes_on else [("127.0.0.1", port, 0, None)])


def refused(*_, **__):
    raise ConnectionRefusedError
