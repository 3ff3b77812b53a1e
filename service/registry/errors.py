"""Errors of the registry, and of a service that gives it to others; every message is one line the user can act on."""

from __future__ import annotations

from service.errors import TandemError
from service.io.errors import StorageError


class RegistryError(StorageError):
    """Something about the registry's files or a request to it is wrong."""


class UnknownVersionError(RegistryError):
    """A name, version or alias that does not exist; the message lists those that do."""


class DamagedBlobError(RegistryError):
    """A saved file whose bytes are not those that were written."""


class StatusError(TandemError):
    """The service cannot be started with these options, or its URL or token is none."""


class FetchError(TandemError):
    """An answer that cannot be used: the service is down or has an error, or something else listens at the URL."""

    exit_code = 1


class WrongTokenError(FetchError):
    """The service needs a token, or another one than was sent."""

    exit_code = 2
