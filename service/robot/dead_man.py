"""A dead-man's switch: a key of the terminal that has to be held down."""

from __future__ import annotations

import os
import select
import sys
import termios
import time
import tty
from typing import Self

from service.base.errors import TandemError

_RELEASED_S = 0.1
"""A key that is held repeats some 30 times a second; without one for so long it was let go."""
_HELD_S = 1.0
"""A key must be held so long before anything moves: terminals wait half a second before they repeat one."""


class HeldKey:
    """True while any key of a terminal is held down.

    Args:
        descriptor: of the terminal; standard input by default.

    Raises:
        TandemError: it is no terminal.
    """

    def __init__(self, descriptor: int | None = None) -> None:
        self._descriptor = _standard_input() if descriptor is None else descriptor
        if self._descriptor < 0 or not os.isatty(self._descriptor):
            raise TandemError(
                "the dead-man's switch is a key, and standard input is no terminal: run in one, or give "
                "--dead-man none if your robot has a switch of its own"
            )
        self._pressed_s = -float("inf")

    def __enter__(self) -> Self:
        self._settings = termios.tcgetattr(self._descriptor)
        tty.setcbreak(self._descriptor)
        return self

    def __exit__(self, *error: object) -> None:
        termios.tcsetattr(self._descriptor, termios.TCSAFLUSH, self._settings)

    def __call__(self) -> bool:
        """Whether a key is held now."""
        while select.select([self._descriptor], [], [], 0.0)[0]:
            if not os.read(self._descriptor, 1024):
                return False
            self._pressed_s = time.monotonic()
        return time.monotonic() - self._pressed_s <= _RELEASED_S

    def wait(self) -> None:
        """Return once a key has been held for a second."""
        since_s = time.monotonic()
        while time.monotonic() - since_s < _HELD_S:
            time.sleep(0.02)
            if not self():
                since_s = time.monotonic()


def _standard_input() -> int:
    """Its descriptor, or -1 where it has none."""
    try:
        return sys.stdin.fileno()
    except (AttributeError, OSError, ValueError):
        return -1
