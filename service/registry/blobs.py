"""A store of immutable bytes, each named by its own sha256."""

from __future__ import annotations

import hashlib
from pathlib import Path

from service.base.errors import DamagedBlobError
from service.base.files import os_errors, read_regular, write_atomic

MAX_BYTES = 1024**3
"""Of a blob; the largest primitives there are have about a megabyte."""


class BlobStore:
    """Content-addressed files ``sha256/<digest>`` under a directory; safe for many processes at once."""

    def __init__(self, directory: Path) -> None:
        self._directory = directory

    def path(self, digest: str) -> Path:
        """File of the blob of that digest, there or not."""
        return self._directory / "sha256" / digest

    def put(self, data: bytes) -> str:
        """Store ``data`` and return its sha256 in hex; bytes already there and whole are not written again.

        Raises:
            StorageError: the disk is full or cannot be written; nothing is left behind.
        """
        digest = sha256_of(data)
        try:
            self.get(digest)
        except DamagedBlobError:  # or not there yet
            write_atomic(self.path(digest), data)
        return digest

    def get(self, digest: str) -> bytes:
        """The bytes of that sha256 in hex, verified.

        Raises:
            DamagedBlobError: the file is missing or holds other bytes.
            StorageError: the file cannot be read.
        """
        path = self.path(digest)
        with os_errors("read", path):
            try:
                data = read_regular(path, MAX_BYTES, follow=True)
            except FileNotFoundError:
                raise DamagedBlobError(f"blob {path} is missing; {_MEND}") from None
        check_digest(path, data, digest)
        return data


def check_digest(place: Path | str, data: bytes, digest: str) -> None:
    """Check that the bytes read from ``place`` are those of ``digest``.

    Raises:
        DamagedBlobError: they are not.
    """
    if (actual := sha256_of(data)) != digest:
        raise DamagedBlobError(f"{place} is damaged: expected sha256 {digest}, it has {actual}; {_MEND}")


def sha256_of(data: bytes) -> str:
    """The sha256 of ``data`` in hex."""
    return hashlib.sha256(data).hexdigest()


_MEND = "restore the file from a copy, or publish the same parameters again"
