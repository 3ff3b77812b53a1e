"""Strikes: what they are made of, and their page."""

import json
import socket
import subprocess
import sys
import threading
from datetime import UTC, datetime
from types import SimpleNamespace

import pytest

from benchmarks.report import attacks
from service.store.models import RunStatus
from tests.status.runs import status
from tools.strike_freezes import Freeze, endings
from tools.strike_runs import Network, Strike, Watcher, changed
from tools.strikes import ROOT, strikes

MACHINE = {"num_cpus": 2, "cpu": "a processor", "git_commit": "a" * 40, "time": "2026-11-24T10:00:00+00:00"}


class Told:
    """A training whose statuses are given."""

    def __init__(self, *statuses: RunStatus) -> None:
        self._statuses = list(statuses)

    def status(self):
        return self._statuses.pop(0) if len(self._statuses) > 1 else self._statuses[0]


@pytest.fixture
def echo():
    """Port of a server that sends back what it gets."""
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def serve():
            connection, _ = listener.accept()
            with connection:
                while data := connection.recv(100):
                    connection.sendall(data)

        threading.Thread(target=serve, daemon=True).start()
        yield listener.getsockname()[1]


def test_a_network_that_parts_lets_nothing_through_and_loses_nothing(echo):
    with Network(echo) as network, socket.create_connection(("127.0.0.1", network.port), timeout=60.0) as connection:
        connection.sendall(b"one")
        assert connection.recv(100) == b"one"
        network.parted.set()
        connection.sendall(b"two")
        connection.settimeout(0.2)
        with pytest.raises(TimeoutError):
            connection.recv(100)
        network.parted.clear()
        connection.settimeout(60.0)
        assert connection.recv(100) == b"two"


def test_a_watcher_notes_each_change_of_condition_and_each_kind_of_warning_once():
    well, full = status("cube"), status("cube").suffering("disk", "3 bytes are left")
    strike = Strike("disk-full", "be told")
    watcher = Watcher(Told(well, well, full, full.suffering("disk", "2 bytes are left"), well), strike)
    assert watcher.until(lambda each: each.condition == "disk", 60.0) is not None
    assert watcher.until_well() is not None
    assert [(state, condition) for _, state, condition in strike.conditions] == [
        ("running", "well"),
        ("running", "disk"),
        ("running", "well"),
    ]
    assert strike.warnings == ["3 bytes are left"]
    assert watcher.until(lambda each: each.condition == "stuck", 0.3) is None


def test_a_strike_with_a_traceback_is_missed():
    strike = Strike("a", "b", tracebacks=1)
    strike.judge("as it must", reached=True)
    assert strike.reached is False


def test_the_innocent_are_those_that_were_not_struck():
    before = {"rollout-0": (1, 0), "rollout-1": (2, 0), "learner": (3, 0)}
    assert changed(before, {"rollout-0": (9, 1), "rollout-1": (2, 0), "learner": (8, 1)}, but="learner") == [
        "rollout-0"
    ]
    assert changed(before, {"rollout-0": (1, 0), "learner": (3, 0)}) == ["rollout-1"]


def test_an_unknown_strike_is_refused_with_those_there_are():
    command = [sys.executable, "-m", "tools.strikes", "--only", "rain"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=400, check=False)
    assert done.returncode == 2
    assert "no strike 'rain'" in done.stderr
    assert "two-drivers" in done.stderr


def test_endings_that_no_freeze_justifies(tmp_path):
    gone = ["the learner is gone (no progress for 31 s); another goes on from its last state"] * 2
    gone += ["rollout actor 1 is gone (it died); another takes its place", "the learner is back, as its incarnation 1"]
    lines = [
        {"at": f"2026-11-26T10:0{minute}:00+00:00", "level": "warning", "text": text}
        for minute, text in enumerate(gone)
    ]
    (tmp_path / "log.jsonl").write_text("".join(f"{json.dumps(line)}\n" for line in lines))
    training = SimpleNamespace(directory=SimpleNamespace(path=tmp_path))
    at = datetime(2026, 11, 26, 10, tzinfo=UTC).timestamp()
    freezes = [Freeze(at - 200.0, "learner", "learner", 25.0), Freeze(at + 28.0, "learner", "learner", 31.0)]
    found = endings(training, freezes)
    assert [(each["worker"], each["justified"]) for each in found] == [
        ("learner", False), ("learner", True), ("1", False)
    ]  # fmt: skip


def test_the_recorded_strikes_are_those_there_are():
    recorded = json.loads((ROOT / "docs" / "results" / "strikes.json").read_text())["strikes"]
    asked = {name: must for name, (must, _) in strikes(600.0, 300.0, 4).items()}
    assert {each["name"]: each["must"] for each in recorded} == asked


def test_the_page_says_what_each_strike_came_to():
    strike = {"must": "well", "measured": "x", "tracebacks": 0}
    conditions = [(0.0, "running", "well"), (12.3, "running", "stuck"), (80.0, "interrupted", "well")]
    result = {
        "machine": MACHINE,
        "strikes": [
            strike | {"name": "driver-frozen", "reached": False, "conditions": conditions},
            strike | {"name": "spinning", "reached": True, "conditions": [(0.1, "running", "well")]},
            strike | {"name": "disk-full", "reached": None, "conditions": []},
        ],
    }
    page = attacks.strikes_table(result)
    assert "| driver frozen | well | x | well from 0 s, stuck from 12 s, interrupted from 80 s | **missed** |" in page
    assert "| spinning | well | x | well | reached |" in page
    assert "| disk full | well | x |  | not measured |" in page
    assert attacks.strikes_words(result).startswith("1 of 2 strikes ended as they must; 0 tracebacks")
