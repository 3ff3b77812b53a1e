import os

import pytest

from service.base.errors import TandemError
from service.robot import watchdogs


def test_a_key_counts_while_it_repeats(monkeypatch):
    clock = [100.0]
    monkeypatch.setattr(watchdogs.time, "monotonic", lambda: clock[0])
    ours, theirs = os.openpty()
    try:
        with watchdogs.HeldKey(theirs) as held:
            assert not held()
            for _ in range(5):
                os.write(ours, b" ")
                clock[0] += 0.05
                while not held():  # until the terminal has handed it on
                    pass
            clock[0] += 0.2
            assert not held()
            steps = iter([*[b" "] * 10, b"", *[b" "] * 60])

            def press(seconds):
                os.write(ours, next(steps))
                clock[0] += 0.05

            monkeypatch.setattr(watchdogs.time, "sleep", press)
            before_s = clock[0]
            held.wait()
            assert clock[0] - before_s >= 1.0
    finally:
        os.close(ours)
        os.close(theirs)


def test_without_a_terminal_there_is_no_key():
    reading, writing = os.pipe()
    with pytest.raises(TandemError, match="no terminal: run in one"):
        watchdogs.HeldKey(reading)
    os.close(reading)
    os.close(writing)
