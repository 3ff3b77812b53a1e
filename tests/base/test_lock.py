"""One process at a time in a directory."""

import logging
import os
import signal
import subprocess
import sys
import time

import pytest

from service.base import lock
from service.base.errors import RunTakenError, StorageError
from service.base.lock import DirectoryLock, is_locked
from tests.runs.runs import assert_one_line

HOLD = """
import sys, time
from pathlib import Path
from service.base.lock import DirectoryLock
lock = DirectoryLock(Path(sys.argv[1]), "wait")
print("locked", flush=True)
time.sleep(60)
"""


@pytest.fixture
def other(tmp_path):
    """Another process, which holds the lock."""
    with subprocess.Popen([sys.executable, "-c", HOLD, tmp_path], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout.readline() == "locked\n"
        yield process
        process.kill()


def test_a_second_process_is_refused_in_one_line(tmp_path, other):
    with pytest.raises(RunTakenError) as error:
        DirectoryLock(tmp_path, "name another one")
    assert_one_line(error.value, tmp_path, f"process {other.pid} on {os.uname().nodename}", "name another one")


def test_a_process_that_is_killed_leaves_no_lock(tmp_path, other):
    assert is_locked(tmp_path)
    other.send_signal(signal.SIGKILL)
    other.wait()
    assert not is_locked(tmp_path)
    DirectoryLock(tmp_path, "").release()


def test_a_lock_is_waited_for(tmp_path, other, monkeypatch):
    monkeypatch.setattr(lock, "WAIT_S", 600.0)
    start_s = time.monotonic()
    signal.signal(signal.SIGALRM, lambda *_: other.kill())
    signal.setitimer(signal.ITIMER_REAL, 0.2)
    DirectoryLock(tmp_path, "").release()
    assert time.monotonic() - start_s >= 0.2


def test_asking_does_not_take_the_lock(tmp_path):
    assert not is_locked(tmp_path)
    first = DirectoryLock(tmp_path, "")
    assert is_locked(tmp_path)
    assert is_locked(tmp_path)
    first.release()
    first.release()
    assert not is_locked(tmp_path)
    with pytest.raises(RunTakenError):  # an object counts as a process does
        _ = DirectoryLock(tmp_path, ""), DirectoryLock(tmp_path, "")


def test_a_damaged_lock_file_is_as_good_as_any(tmp_path):
    (tmp_path / ".lock").write_bytes(b"\xff{")
    first = DirectoryLock(tmp_path, "")
    (tmp_path / ".lock").write_bytes(b"\xff{")
    with pytest.raises(RunTakenError, match="in use by another process"):
        DirectoryLock(tmp_path, "")
    first.release()


@pytest.mark.parametrize(
    ("make", "reason"),
    [(lambda path: path.symlink_to(path.with_name("precious")), "a symbolic link"), (os.mkfifo, "not a regular file")],
)
def test_what_is_no_lock_file_is_not_written(tmp_path, make, reason):
    (tmp_path / "precious").write_text("precious")
    make(tmp_path / ".lock")
    with pytest.raises(StorageError) as error:
        DirectoryLock(tmp_path, "")
    assert_one_line(error.value, "cannot write", tmp_path / ".lock", reason)
    assert not is_locked(tmp_path)
    assert (tmp_path / "precious").read_text() == "precious"


def test_a_file_system_without_locks_is_refused_unless_one_says_so(tmp_path, monkeypatch, caplog):
    def unsupported(*_):
        raise OSError(95, "Operation not supported")

    monkeypatch.setattr("fcntl.flock", unsupported)
    with pytest.raises(RunTakenError) as error:
        DirectoryLock(tmp_path, "")
    assert_one_line(error.value, tmp_path, "no locks", "Operation not supported", "TANDEM_WITHOUT_LOCKS=1")
    monkeypatch.setenv("TANDEM_WITHOUT_LOCKS", "1")
    with caplog.at_level(logging.WARNING):
        DirectoryLock(tmp_path, "").release()
    assert_one_line(caplog.messages[0], tmp_path, "no locks", "Operation not supported")
