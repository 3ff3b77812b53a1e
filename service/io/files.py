"""Files that are wholly there or not at all, also after a kill or a power cut.

Every write goes to a temporary file beside its target, is flushed to the disk, and then takes its name in one step. A
temporary file's name starts with ``.tmp-``, which no name or alias can, so readers never meet one.
"""

from __future__ import annotations

import contextlib
import os
import secrets
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Literal

from service.io.errors import StorageError

TEMPORARY_PREFIX = ".tmp-"


def write_atomic(path: Path, data: bytes, *, flush: bool = True) -> None:
    """Put ``data`` at ``path``, replacing what was there in one step; the directory is made when missing.

    Args:
        path: where to.
        data: its new content.
        flush: wait for the disk. Without, it is quick, and a power cut may leave an older content or none.

    Raises:
        OSError: the disk is full, or the directory cannot be written; ``path`` is then as it was.
    """
    with _temporary(path, data, flush=flush) as temporary:
        temporary.replace(path)
        if flush:
            _flush_directory(path.parent)


def write_exclusive(path: Path, data: bytes) -> bool:
    """Put ``data`` at ``path`` unless something is there; True when it was put. One of many racing writers wins.

    Raises:
        OSError: as for `write_atomic`, or the file system has no hard links.
    """
    with _temporary(path, data) as temporary:
        try:
            os.link(temporary, path)
        except FileExistsError:
            return False
        _flush_directory(path.parent)
        return True


@contextlib.contextmanager
def os_errors(
    action: Literal["read", "write"], path: Path, error_type: type[StorageError] = StorageError
) -> Iterator[None]:
    """Turn an operating-system error of the block into ``error_type`` with one line for the user.

    Args:
        action: what was being done.
        path: the file it was done to.
        error_type: what to raise.
    """
    try:
        yield
    except OSError as error:
        reason = error.strerror or type(error).__name__
        if action == "read":
            raise error_type(f"cannot read {path}: {reason}; check the path, its permissions and the disk") from error
        raise error_type(
            f"cannot write {path}: {reason} ({_free_bytes(path)} bytes free there); "
            "free some space or check the permissions and try again; what was saved before is intact"
        ) from error


def remove_temporaries(directory: Path) -> None:
    """Delete what killed writers left in ``directory``; only where no other writer can be at work."""
    for path in directory.glob(f"{TEMPORARY_PREFIX}*"):
        path.unlink(missing_ok=True)


@contextlib.contextmanager
def _temporary(path: Path, data: bytes, *, flush: bool = True) -> Iterator[Path]:
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.parent / f"{TEMPORARY_PREFIX}{os.getpid()}-{secrets.token_hex(8)}"
    try:
        if flush:
            _write_flushed(temporary, data)
        else:
            temporary.write_bytes(data)
        yield temporary
    finally:
        temporary.unlink(missing_ok=True)


def _write_flushed(path: Path, data: bytes) -> None:
    # 0o666 before the umask: tempfile's 0o600 would lock colleagues out of a shared registry
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666)
    try:
        view = memoryview(data)
        while view:
            view = view[os.write(descriptor, view) :]
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _flush_directory(directory: Path) -> None:
    descriptor = os.open(directory, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _free_bytes(path: Path) -> int:
    existing = next(parent for parent in path.absolute().parents if parent.exists())
    return shutil.disk_usage(existing).free
