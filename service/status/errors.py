"""What can go wrong with starting the status service, and with asking one."""

from __future__ import annotations

from service.errors import TandemError


class StatusError(TandemError):
    """The service cannot be started as asked."""


class FetchError(TandemError):
    """A status service gave no usable answer: it is down, it is none, or something is wrong on its side."""

    exit_code = 1


class WrongTokenError(FetchError):
    """A status service wants a token, or another one."""

    exit_code = 2
