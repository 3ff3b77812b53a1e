"""Errors of reading and writing the reports of runs."""

from __future__ import annotations

from service.errors import TandemError


class StoreError(TandemError):
    """The store cannot do what was asked."""


class UnknownRunError(StoreError):
    """A run id that does not exist; the message lists those that do."""

    @classmethod
    def of(cls, run_id: str, where: object, known: list[str]) -> UnknownRunError:
        """The error for ``run_id``, which is not among the runs ``known`` to be at ``where``."""
        shown = ", ".join(known[:20]) + (f" and {len(known) - 20} more" if len(known) > 20 else "")
        return cls(f"no run {run_id[:128]!r} in {where}; it holds: {shown or 'nothing yet'}")


class StoreUnavailableError(StoreError):
    """The store cannot be reached at the moment."""

    exit_code = 1


class DamagedStoreError(StoreError):
    """The store holds a value that no run has written."""

    exit_code = 1
