"""Where services listen: at a port, or at the next free one where several run on one machine."""

from __future__ import annotations

import errno
import logging
import socket

DEFAULT_PORT = 8321
"""Of the status service."""
MAX_TRIED = 50
_logger = logging.getLogger(__name__)


def listen(host: str, port: int) -> socket.socket:
    """A socket that listens at a port of a host, a name or an address of this machine; 0: any port that is free.

    Raises:
        OSError: the port is taken, or there is no such host here.
    """
    try:
        family, _, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)[0]
        return socket.create_server(address, family=family, dualstack_ipv6=family == socket.AF_INET6)
    except UnicodeError as error:  # such as of two dots in a row
        raise OSError(errno.EINVAL, f"{host!r} is no name of a host") from error


def url_of(host: str, port: int) -> str:
    """URL for programs on this machine of what listens at a port of a host, which may stand for all addresses."""
    host = {"": "127.0.0.1", "0.0.0.0": "127.0.0.1", "::": "::1"}.get(host, host)
    return f"http://{f'[{host}]' if ':' in host else host}:{port}"


def free_port(host: str, first: int = 0) -> int:
    """The first free port from ``first`` on, or ``first`` where none of ``MAX_TRIED`` is; 0: any that is free.

    Raises:
        OSError: there is no such host here.
    """
    for port in range(first, min(first + MAX_TRIED, 65536)):
        try:
            with listen(host, port) as probe:
                return int(probe.getsockname()[1])
        except OSError as error:
            if error.errno != errno.EADDRINUSE:
                raise
    return first


def choose_port(host: str, port: int | None) -> int:
    """The port of a status service: the one that is named; 0: any that is free; None: the usual one, or the next free.

    A line says where the usual one is taken. What is wrong with a host is said where the service begins.
    """
    if port:
        return port
    first = DEFAULT_PORT if port is None else 0
    try:
        found = free_port(host, first)
    except OSError:
        return first
    if first not in (0, found):
        _logger.info("port %d is taken, so the status service is at port %d", first, found)
    return found
