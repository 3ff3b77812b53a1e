"""Blobs to hand out: never one whose bytes are not those of its digest, for caches would keep it for ever."""

from __future__ import annotations

import os
from pathlib import Path

from service.registry.blobs import BlobStore
from service.status.problems import ProblemError


class VerifiedBlobs:
    """The blobs of a registry, each read through once before it is first handed out, and again if its file changed."""

    def __init__(self, directory: Path) -> None:
        """For a registry's ``blobs``."""
        self._store = BlobStore(directory)
        self._verified: dict[str, tuple[int, int, int]] = {}

    def path(self, digest: str) -> Path:
        """Where the blob is.

        Raises:
            ProblemError: there is none.
            DamagedBlobError: its bytes are others.
        """
        path = self._store.path(digest)
        try:
            status = os.stat(path)
        except FileNotFoundError:
            raise ProblemError(
                404, "unknown-blob", f"no blob {digest} here; a manifest names the ones there are"
            ) from None
        stamp = (status.st_mtime_ns, status.st_size, status.st_ino)
        if self._verified.get(digest) != stamp:
            self._store.get(digest)
            self._verified[digest] = stamp
        return path
