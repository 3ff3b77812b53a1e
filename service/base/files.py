"""Files that are wholly there or not at all, files that grow by whole pieces, and regular files, read without waiting.

A whole file is written to a temporary file beside its target, flushed to the disk, and then takes its name in one step,
so a kill or a power cut leaves the old one or the new one. A temporary file's name starts with ``.tmp-``, which no name
or alias can, so readers never meet one. A full disk leaves no torn piece at the end of a growing file.

Another program may have put something else where a user or a run expects a file. A FIFO may wait for ever, and a
device may never end. So only regular files are opened, and no more is read than a file of its kind can have.
"""

from __future__ import annotations

import contextlib
import errno
import os
import secrets
import shutil
import stat
from collections import deque
from collections.abc import Iterator
from io import FileIO
from pathlib import Path
from typing import BinaryIO, Literal

from service.base.errors import StorageError

TEMPORARY_PREFIX = ".tmp-"
MAX_BYTES = 8 * 1024**3
"""Greatest size of a file of a run: of a million iterations its records have some two gigabytes."""
END_BYTES = 16 * 1024
"""Of the end of a text file."""


def open_regular(path: Path, *, follow: bool = False) -> BinaryIO:
    """Open a regular file to read it.

    Args:
        path: of the file.
        follow: whether it may be a link to one.

    Raises:
        OSError: it cannot be opened, or is something else than a regular file; ``strerror`` says which.
    """
    return open(_descriptor(path, os.O_RDONLY, follow=follow), "rb")


def open_to_append(path: Path) -> FileIO:
    """Open a regular file to append to it, and make it when missing; what a link leads to is not ours to change.

    Raises:
        OSError: as for ``open_regular``.
    """
    return FileIO(_descriptor(path, os.O_RDWR | os.O_APPEND | os.O_CREAT, follow=False), "a")


def read_regular(path: Path, max_bytes: int = MAX_BYTES, *, follow: bool = False) -> bytes:
    """Read a regular file as it is now.

    Args:
        path: of the file.
        max_bytes: that it may have.
        follow: whether it may be a link to one.

    Raises:
        OSError: as for ``open_regular``, or it is longer.
    """
    with open_regular(path, follow=follow) as file:
        size = os.fstat(file.fileno()).st_size
        if size > max_bytes:
            raise OSError(errno.EFBIG, f"longer than {max_bytes} bytes", str(path))
        return file.read(size)


def last_lines(path: Path) -> list[str]:
    """The lines at the end of a text file, without empty ones and one that is cut; none where it cannot be read."""
    try:
        with open_regular(path) as file:
            begin = max(0, file.seek(0, os.SEEK_END) - END_BYTES)
            file.seek(begin)
            text = file.read(END_BYTES).decode(errors="replace")
    except OSError:
        return []
    return [line for line in text.replace("\r", "\n").split("\n")[1 if begin else 0 :] if line.strip()]


def _descriptor(path: Path, flags: int, *, follow: bool) -> int:
    if not follow and os.path.islink(path):
        raise OSError(errno.ELOOP, "a symbolic link, which is not followed", str(path))
    descriptor = os.open(path, flags | os.O_NONBLOCK | os.O_CLOEXEC, 0o666)
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise OSError(errno.EINVAL, "not a regular file", str(path))
    return descriptor


def write_atomic(
    path: Path,
    data: bytes | Iterator[bytes],
    error_type: type[StorageError] = StorageError,
    *,
    flush: bool = True,
) -> None:
    """Put ``data`` at ``path``, replacing what was there in one step; the directory is made when missing.

    Args:
        path: of the file.
        data: all that it holds then, or pieces of that, one after another.
        error_type: of the error.
        flush: whether to wait for the disk; without that, a power cut may leave an older content or none.

    Raises:
        StorageError: the disk is full, or the directory cannot be written; ``path`` is then as it was.
    """
    with os_errors("write", path, error_type), _temporary(path, data, flush=flush) as temporary:
        temporary.replace(path)
        if flush:
            _flush_directory(path.parent)


def write_exclusive(path: Path, data: bytes) -> bool:
    """Put ``data`` at ``path`` unless something is there; True when it was put. One of many racing writers wins.

    Raises:
        StorageError: as for `write_atomic`, or the file system has no hard links.
    """
    with os_errors("write", path), _temporary(path, data) as temporary:
        try:
            os.link(temporary, path)
        except FileExistsError:
            return False
        _flush_directory(path.parent)
        return True


def check_place(path: Path) -> None:
    """Check that a file can be written at ``path``, before the work whose result it is to hold.

    Its directory is made where it is missing.

    Raises:
        StorageError: it cannot.
    """
    above = next(parent for parent in path.absolute().parents if os.path.exists(parent))
    if not above.is_dir():
        raise StorageError(f"cannot write {path}: {above} is no directory; name another place")
    with os_errors("write", path), _temporary(path, b"", flush=False):
        if path.is_dir():
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))


@contextlib.contextmanager
def new_directory(path: Path) -> Iterator[Path]:
    """Give an empty directory beside ``path``, which takes that name when the block ends well, and else is removed.

    Raises:
        StorageError: something is at ``path`` already, or it cannot be written.
    """
    if path.exists() or path.is_symlink():
        raise StorageError(f"cannot write {path}: it exists; name another folder, or remove it first")
    temporary = path.absolute().parent / _temporary_name()
    with os_errors("write", path):
        temporary.mkdir(parents=True)
    try:
        yield temporary
        with os_errors("write", path):
            temporary.rename(path)
            _flush_directory(temporary.parent)
    except BaseException:
        shutil.rmtree(temporary, ignore_errors=True)
        raise


@contextlib.contextmanager
def os_errors(
    action: Literal["read", "write"], path: Path, error_type: type[StorageError] = StorageError
) -> Iterator[None]:
    """Turn an operating-system error of the block into ``error_type`` with one line for the user."""
    try:
        yield
    except OSError as error:
        reason = error.strerror or type(error).__name__
        if action == "read":
            raise error_type(f"cannot read {path}: {reason}; check the path, its permissions and the disk") from error
        full = error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
        to_do = "free some space" if full else "check the path and its permissions"
        raise error_type(
            f"cannot write {path}: {reason}{_free_there(path) if full else ''}; {to_do} and try again; "
            "what was saved before is intact"
        ) from error


def remove_temporaries(directory: Path) -> None:
    """Delete the files that killed writers left in ``directory``; only where no other writer can be at work.

    A directory stays: it is of a ``new_directory`` that may still be filled.
    """
    for path in directory.glob(f"{TEMPORARY_PREFIX}*"):
        if not path.is_dir():
            path.unlink(missing_ok=True)


class Appender:
    """Appends pieces to one file; a piece that does not fit waits, and comes before the next one.

    Once it has written to the file, it writes to no other: a process that goes on with a run puts new files in the
    places of those it continues, so one that was overtaken without noticing writes to nothing that anybody reads.

    Args:
        path: the file; what is there already stays, and nothing is made before the first piece.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._waiting: deque[bytes] = deque()
        self._identity: tuple[int, int] | None = None
        """Device and inode of the file that it writes to."""

    def append_bytes(self, piece: bytes) -> None:
        """Put ``piece`` at the file's end and hand it to the operating system.

        Raises:
            StorageError: the disk is full or the file cannot be written; the file ends with a whole piece, and
                ``piece`` waits for the next call or `sync`.
        """
        self._waiting.append(piece)
        self._flush()

    def take_new_file(self) -> None:
        """Write to whichever file is there next; what waits was for the file before."""
        self._identity = None
        self._waiting.clear()

    def sync(self) -> None:
        """Write what waits, and wait until the disk has it.

        Raises:
            StorageError: as for `append_bytes`.
        """
        self._flush()
        nothing_there = contextlib.suppress(FileNotFoundError, NotADirectoryError)
        with os_errors("write", self.path), nothing_there, open_regular(self.path) as file:
            os.fsync(file.fileno())

    def _flush(self) -> None:
        if not self._waiting:
            return
        with os_errors("write", self.path):
            self.path.parent.mkdir(parents=True, exist_ok=True)
            with open_to_append(self.path) as file:
                self._check_same(file)
                while self._waiting:
                    _write_whole(file, self._waiting[0])
                    self._waiting.popleft()

    def _check_same(self, file: FileIO) -> None:
        there = os.fstat(file.fileno())
        identity = there.st_dev, there.st_ino
        if self._identity not in (None, identity) and there.st_size:  # an empty one takes the place of one removed
            raise OSError(errno.ESTALE, "another process has put a file of its own in its place", str(self.path))
        self._identity = identity


@contextlib.contextmanager
def _temporary(path: Path, data: bytes | Iterator[bytes], *, flush: bool = True) -> Iterator[Path]:
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.parent / _temporary_name()
    try:
        if flush:
            _write_flushed(temporary, data)
        else:
            temporary.write_bytes(data if isinstance(data, bytes) else b"".join(data))
        yield temporary
    finally:
        temporary.unlink(missing_ok=True)


def _temporary_name() -> str:
    return f"{TEMPORARY_PREFIX}{os.getpid()}-{secrets.token_hex(8)}"


def _write_flushed(path: Path, data: bytes | Iterator[bytes]) -> None:
    with open(path, "xb") as file:
        file.writelines([data] if isinstance(data, bytes) else data)
        file.flush()
        os.fsync(file.fileno())


def _flush_directory(directory: Path) -> None:
    descriptor = os.open(directory, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _free_there(path: Path) -> str:
    """How much room there is, in brackets; nothing where the disk does not say."""
    existing = next(parent for parent in path.absolute().parents if os.path.exists(parent))
    with contextlib.suppress(OSError):
        return f" ({shutil.disk_usage(existing).free} bytes free there)"
    return ""


def _write_whole(file: FileIO, piece: bytes) -> None:
    end = file.seek(0, os.SEEK_END)
    try:
        view = memoryview(piece)
        while view:
            view = view[file.write(view) :]
    except BaseException:  # a signal's, too
        with contextlib.suppress(OSError):  # the first error is the one the user has to know
            file.truncate(end)
        raise
