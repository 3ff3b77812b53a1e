"""Errors of starting a status service and of using one."""

from __future__ import annotations

from service.errors import TandemError


class StatusError(TandemError):
    """The service cannot be started with these options."""


class FetchError(TandemError):
    """An answer that cannot be used: the service is down or has an error, or something else listens at the URL."""

    exit_code = 1


class WrongTokenError(FetchError):
    """The service needs a token, or another one than was sent."""

    exit_code = 2
