"""Errors of files and directories."""

from __future__ import annotations

from service.errors import TandemError


class StorageError(TandemError):
    """A file or directory cannot be read or written."""


class FormatVersionError(StorageError):
    """A file was written in another format than this program reads."""

    @classmethod
    def of(cls, where: object, *, found: object, supported: int) -> FormatVersionError:
        """The error for ``where``, a file whose format version is ``found``."""
        return cls(
            f"{where}: format version {found!r} found, this tandem reads {supported}; "
            "read it with the tandem that wrote it, or train and publish again with this one"
        )


class CheckpointError(StorageError):
    """A run's checkpoint is missing, unusable, or cannot be written."""


class RunTakenError(StorageError):
    """Another process uses this directory, or runs this run."""
