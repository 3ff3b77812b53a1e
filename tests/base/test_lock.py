"""One process at a time in a directory, and the number of each that ever ran a run, of which the highest counts."""

import logging
import os
import signal
import subprocess
import sys
import time

import pytest

from service.base import lock
from service.base.errors import RunTakenError, StorageError
from service.base.lock import DirectoryLock, claim_epoch, is_locked, newest_epoch
from tests.runs.runs import assert_one_line

HOLD = """
import sys, time
from pathlib import Path
from service.base.lock import DirectoryLock
lock = DirectoryLock(Path(sys.argv[1]))
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


def test_a_second_process_is_refused_in_one_line_until_the_first_is_killed(tmp_path, other, monkeypatch):
    with pytest.raises(RunTakenError) as error:
        DirectoryLock(tmp_path)
    assert_one_line(error.value, tmp_path, f"process {other.pid} on {os.uname().nodename}", "name another --run-dir")
    assert is_locked(tmp_path)
    monkeypatch.setattr(lock, "WAIT_S", 600.0)  # it is waited for
    start_s = time.monotonic()
    signal.signal(signal.SIGALRM, lambda *_: other.kill())
    signal.setitimer(signal.ITIMER_REAL, 0.2)
    DirectoryLock(tmp_path).release()
    assert time.monotonic() - start_s >= 0.2
    assert not is_locked(tmp_path)


def test_asking_does_not_take_the_lock(tmp_path):
    assert not is_locked(tmp_path)
    first = DirectoryLock(tmp_path)
    assert is_locked(tmp_path)
    assert is_locked(tmp_path)
    first.release()
    first.release()
    assert not is_locked(tmp_path)


def test_a_damaged_lock_file_is_as_good_as_any(tmp_path, monkeypatch):
    monkeypatch.setattr(lock, "WAIT_S", 0.0)
    (tmp_path / ".lock").write_bytes(b"\xff{")
    first = DirectoryLock(tmp_path)
    (tmp_path / ".lock").write_bytes(b"\xff{")
    with pytest.raises(RunTakenError, match="in use by another process"):  # an object counts as a process does
        DirectoryLock(tmp_path)
    first.release()


@pytest.mark.parametrize(
    ("make", "reason"),
    [(lambda path: path.symlink_to(path.with_name("precious")), "a symbolic link"), (os.mkfifo, "not a regular file")],
)
def test_what_is_no_lock_file_is_not_written(tmp_path, make, reason):
    (tmp_path / "precious").write_text("precious")
    make(tmp_path / ".lock")
    with pytest.raises(StorageError) as error:
        DirectoryLock(tmp_path)
    assert_one_line(error.value, "cannot write", tmp_path / ".lock", reason)
    assert not is_locked(tmp_path)
    assert (tmp_path / "precious").read_text() == "precious"


def test_a_file_system_without_locks_is_refused_unless_one_says_so(tmp_path, monkeypatch, caplog):
    def unsupported(*_):
        raise OSError(95, "Operation not supported")

    monkeypatch.setattr("fcntl.flock", unsupported)
    with pytest.raises(RunTakenError) as error:
        DirectoryLock(tmp_path)
    assert_one_line(error.value, tmp_path, "no locks", "Operation not supported", "TANDEM_WITHOUT_LOCKS=1")
    monkeypatch.setenv("TANDEM_WITHOUT_LOCKS", "1")
    with caplog.at_level(logging.WARNING):
        DirectoryLock(tmp_path).release()
    assert_one_line(caplog.messages[0], tmp_path, "no locks", "Operation not supported")


# --- epochs ----------------------------------------------------------------------------------------------------------


def test_each_number_is_claimed_once(tmp_path, monkeypatch):
    """Another process takes the number that this one has just seen to be free."""

    def look(numbers):
        monkeypatch.undo()
        seen = newest_epoch(tmp_path)
        assert claim_epoch(tmp_path) == 1
        return seen

    monkeypatch.setattr(lock, "_newest", look)
    assert claim_epoch(tmp_path) == 2
    assert (newest_epoch(tmp_path), claim_epoch(tmp_path)) == (2, 3)


def test_a_number_beyond_eight_digits(tmp_path):
    """It once made a run that was resumed hang for ever."""
    (tmp_path / "epochs").mkdir()
    (tmp_path / "epochs" / "99999999").touch()
    assert (claim_epoch(tmp_path), claim_epoch(tmp_path)) == (10**8, 10**8 + 1)
    (tmp_path / "epochs" / ("9" * 255)).touch()
    with pytest.raises(StorageError) as error:
        claim_epoch(tmp_path)
    assert_one_line(error.value, tmp_path, "File name too long")
