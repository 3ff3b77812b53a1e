"""Errors of the registry; every message is one line the user can act on."""

from __future__ import annotations

from service.io.errors import StorageError


class RegistryError(StorageError):
    """Something about the registry's files or a request to it is wrong."""


class UnknownVersionError(RegistryError):
    """A name, version or alias that does not exist; the message lists those that do."""


class DamagedBlobError(RegistryError):
    """A saved file whose bytes are not those that were written."""
