"""The port of the status service, and the next free one where several run on one machine."""

from __future__ import annotations

import errno
import socket

DEFAULT_PORT = 8321
MAX_TRIED = 50


def free_port(host: str, first: int = 0) -> int:
    """The first free port from ``first`` on, or ``first`` where none of ``MAX_TRIED`` is; 0: any that is free.

    Args:
        host: an IPv4 or IPv6 address, or a name.
        first: to be tried.

    Raises:
        OSError: there is no such host here.
    """
    try:
        family, _, _, _, address = socket.getaddrinfo(host, first, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)[0]
    except UnicodeError as error:
        raise OSError(errno.EINVAL, f"{host!r} is no name of a host") from error
    for port in range(first, min(first + MAX_TRIED, 65536)):
        with socket.socket(family) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # as the service itself
            try:
                probe.bind((address[0], port))
            except OSError:
                continue
            return int(probe.getsockname()[1])
    return first
