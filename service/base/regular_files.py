"""Regular files, opened without waiting: whatever a user names, or a run finds in its directory, is opened here.

Another program may have put something else there. A FIFO may wait for ever, and a device may never end.
"""

from __future__ import annotations

import errno
import os
import stat
from io import FileIO
from pathlib import Path
from typing import BinaryIO


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


def read_regular(path: Path, max_bytes: int, *, follow: bool = False) -> bytes:
    """Read a regular file whole.

    Args:
        path: of the file.
        max_bytes: that it may have.
        follow: whether it may be a link to one.

    Raises:
        OSError: as for ``open_regular``, or it is longer.
    """
    with open_regular(path, follow=follow) as file:
        size = os.fstat(file.fileno()).st_size
        data = b"" if size > max_bytes else file.read(size + 1)  # not max_bytes, for which memory would be taken
        if len(data) > size:  # it grows, or is one of the kernel's, which say 0
            data += file.read(max_bytes + 1 - len(data))
        if max(size, len(data)) > max_bytes:
            raise OSError(errno.EFBIG, f"longer than {max_bytes} bytes", str(path))
        return data


def _descriptor(path: Path, flags: int, *, follow: bool) -> int:
    try:
        descriptor = os.open(path, flags | os.O_NONBLOCK | os.O_CLOEXEC | (0 if follow else os.O_NOFOLLOW), 0o666)
    except OSError as error:
        if error.errno != errno.ELOOP or follow or not os.path.islink(path):
            raise
        raise OSError(errno.ELOOP, "a symbolic link, which is not followed", str(path)) from None
    try:
        if not stat.S_ISREG(os.fstat(descriptor).st_mode):
            raise OSError(errno.EINVAL, "not a regular file", str(path))
    except BaseException:
        os.close(descriptor)
        raise
    return descriptor
