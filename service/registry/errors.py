"""What can go wrong with saved things; every message is one line the user can act on."""

from __future__ import annotations

from service.errors import TandemError


class RegistryError(TandemError):
    """Something about the registry's files or a request to it is wrong."""


class UnknownVersionError(RegistryError):
    """A name, version or alias that does not exist; the message lists those that do."""


class DamagedBlobError(RegistryError):
    """A saved file whose bytes are not those that were written."""


class FormatVersionError(RegistryError):
    """A file written in another format than this program reads."""

    @classmethod
    def of(cls, where: object, *, found: object, supported: int) -> FormatVersionError:
        """The error for ``where``, a file whose format version is ``found``."""
        return cls(
            f"{where}: format version {found!r} found, this tandem reads {supported}; "
            "read it with the tandem that wrote it, or train and publish again with this one"
        )


class CheckpointError(RegistryError):
    """A run's checkpoint is missing, unusable, or cannot be written."""
