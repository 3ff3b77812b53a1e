"""Handling of SIGINT, SIGTERM and SIGHUP: a run ends where it can be resumed; the process says which signal it was."""

from __future__ import annotations

import ctypes
import os
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from threading import current_thread, main_thread
from types import FrameType, TracebackType
from typing import Self

from service.base.errors import TandemError

PASSED_ON = signal.SIGUSR1
"""A stop that the process above passes on. It counts only where no other signal came: a supervisor, such as Ray's for
jobs, signals a process and those below it, and what comes twice that way must not count as a second signal."""
STOPPING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, PASSED_ON)
"""The third comes where a terminal is closed or a connection drops; under ``nohup`` it is ignored, and stays so."""
_MAY_COME_TWICE = (signal.SIGHUP, PASSED_ON)
"""The kernel and the shell both tell of a terminal that closes: that is one stop, and not a second signal."""
PARENT = "TANDEM_STUDY_PROCESS"
"""Variable of the environment with the id of the process that a run of a study, or the demo's live world, ends with."""
_PR_SET_PDEATHSIG = 1
"""From linux/prctl.h."""


class InterruptError(KeyboardInterrupt):
    """A signal that ends everything at once. No ``Exception``, so that nothing takes it for an error of its own.

    Ray's own code lets only a ``KeyboardInterrupt`` through, and raises another one of those in its place.
    """

    def __init__(self, number: int) -> None:
        """Keep the signal's number."""
        super().__init__(signal.Signals(number).name)
        self.number = number


class StopSignals:
    """Takes the signals of ``STOPPING`` over while its ``with`` block runs, which has to be in the main thread.

    A signal raises ``InterruptError`` there, except where ``asking`` is told of another way to stop.
    """

    def __init__(self) -> None:
        self.first: int | None = None
        """The first signal that came."""
        self._ask: Callable[[], None] | None = None
        self._terminals = [descriptor for descriptor in range(3) if os.isatty(descriptor)]
        before = {number: signal.getsignal(number) for number in STOPPING}
        self._previous = {number: handler for number, handler in before.items() if not _is_ignored(number, handler)}

    def __enter__(self) -> Self:
        if current_thread() is not main_thread():
            raise TandemError(
                "this needs the main thread, as no other gets signals: call it there, or in a process of its own"
            )
        self._pid = os.getpid()
        for number in self._previous:
            signal.signal(number, self._handle)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)
        if kind is KeyboardInterrupt and self.first is not None:
            raise InterruptError(self.first) from None

    @contextmanager
    def asking(self, ask: Callable[[], None]) -> Iterator[None]:
        """Make the first signal of the block only call ``ask``; a second one raises ``InterruptError``."""
        if self.first is not None:  # what it raised was swallowed, as by the imports of some packages
            ask()
        self._ask = ask
        try:
            yield
        finally:
            self._ask = None

    def _handle(self, number: int, frame: FrameType | None) -> None:
        if os.getpid() != self._pid:  # a process that a user's method forked
            if number == signal.SIGTERM:  # which is for it alone; the others tell a whole terminal
                signal.signal(number, signal.SIG_DFL)
                os.kill(os.getpid(), number)
            return
        if number in _MAY_COME_TWICE and self.first is not None:
            return
        self.first = self.first or number
        if number == signal.SIGHUP:
            _leave(self._terminals)
        ask = self._ask
        if number not in _MAY_COME_TWICE:
            self._ask = None
        if ask is None:
            raise InterruptError(number)
        ask()


def _leave(terminals: list[int]) -> None:
    """Read and write nowhere in place of a terminal that is gone: each further line would be an error."""
    nowhere = os.open(os.devnull, os.O_RDWR)
    for descriptor in terminals:
        os.dup2(nowhere, descriptor)
    os.close(nowhere)


def _is_ignored(number: int, handler: object) -> bool:
    return number == signal.SIGHUP and handler == signal.SIG_IGN


def stop_with_parent() -> None:
    """Let the kernel send ``PASSED_ON`` when the process of the study ends, if this is a run of one.

    Else it would go on alone. Only Linux can do that.
    """
    parent = os.environ.pop(PARENT, None)
    if parent is None:
        return
    if sys.platform == "linux":
        ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, int(PASSED_ON))
    if os.getppid() != int(parent):  # it ended a moment ago, and no signal comes
        sys.exit(128 + PASSED_ON)
