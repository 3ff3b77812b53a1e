"""What can go wrong with reading what runs tell."""

from __future__ import annotations

from service.errors import TandemError


class StoreError(TandemError):
    """Something about the store or a request to it is wrong."""


class UnknownRunError(StoreError):
    """A run id that does not exist; the message lists those that do."""


class StoreUnavailableError(StoreError):
    """The store cannot be reached at the moment."""

    exit_code = 1
