"""Regular files, opened without waiting: a FIFO has nobody at its other end, and a device may never end."""

from __future__ import annotations

import errno
import os
import stat
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
    flags = os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC | (0 if follow else os.O_NOFOLLOW)
    descriptor = os.open(path, flags)
    try:
        if not stat.S_ISREG(os.fstat(descriptor).st_mode):
            raise OSError(errno.EINVAL, "not a regular file", str(path))
    except BaseException:
        os.close(descriptor)
        raise
    return open(descriptor, "rb")


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
