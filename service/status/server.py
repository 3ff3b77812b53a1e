"""The status service on a port, in a thread or in the foreground; independent of Ray."""

from __future__ import annotations

import errno
import logging
import socket
import threading
import time
from collections.abc import Callable

import uvicorn

from service.base.errors import StatusError
from service.base.ports import DEFAULT_PORT, listen, url_of
from service.registry.registry import Registry
from service.status.app import create_app
from service.status.auth import is_loopback
from service.store.models import RunReader

START_TIMEOUT_S = 10.0
STOP_TIMEOUT_S = 5.0
MAX_CONNECTIONS = 512
"""Where so many are open, the asking one among them, a request is answered with 503."""
MAX_HEAD_BYTES = 64 * 1024
"""Request line and headers; a browser's have one or two kilobytes."""
_GRACE_S = 2
_POLL_S = 0.2
_logger = logging.getLogger(__name__)


class StatusServer:
    """Server in a thread, until ``stop`` or the end of the process; as a context manager it starts and stops.

    It listens at ``host``, a name or an address, and ``port``; 0 is a free one, which the attribute ``port`` gives. The
    other arguments are those of `create_app`.

    Raises:
        StatusError: it cannot listen at the address, or the address is public and there is no token.
    """

    def __init__(
        self,
        runs: RunReader,
        registry: Registry,
        *,
        token: str | None = None,
        host: str = "127.0.0.1",
        port: int = DEFAULT_PORT,
    ) -> None:
        self._socket = _listen(host, port)
        address, self.port = self._socket.getsockname()[:2]
        try:
            # public or not depends on the bound address, not on the name of the host
            app = create_app(runs, registry, token=token, public=not is_loopback(address))
        except StatusError:
            self._socket.close()
            raise
        self.url = url_of(address, self.port)
        """URL for clients on this machine."""
        self.app = app
        config = uvicorn.Config(
            app,
            http="h11",  # of requests that come faster than they are answered, httptools keeps all in memory
            h11_max_incomplete_event_size=MAX_HEAD_BYTES,
            limit_concurrency=MAX_CONNECTIONS,
            log_config=None,  # keep the program's own logging
            log_level="critical",  # AuthMiddleware logs what fails; the rest is about clients, who could fill the log
            access_log=False,  # /metrics counts requests
            server_header=False,
            proxy_headers=False,  # nothing depends on them but the cookie, which reads them itself
            lifespan="off",
            ws="none",
            timeout_graceful_shutdown=_GRACE_S,
        )
        self._server = uvicorn.Server(config)
        self._thread = threading.Thread(target=self._serve, name=f"status-{self.port}", daemon=True)

    def start(self) -> None:
        """Start to answer requests, in a thread.

        Raises:
            StatusError: it does not start.
        """
        self._thread.start()
        deadline_s = time.monotonic() + START_TIMEOUT_S
        while not self._server.started:
            if not self._thread.is_alive() or time.monotonic() > deadline_s:
                raise StatusError(f"the status service does not start at port {self.port}; the log says more")
            time.sleep(0.005)

    def stop(self) -> None:
        """Finish open requests, end event streams, and free the port."""
        self.app.state.streams.close()  # or the server would wait for their clients
        self._server.should_exit = True
        if self._thread.is_alive():
            self._thread.join(STOP_TIMEOUT_S)
        self._socket.close()

    def run(self, is_over: Callable[[], bool]) -> None:
        """Serve in the foreground until it is over.

        Raises:
            StatusError: it does not start, or ends by itself.
        """
        try:
            self.start()
            while not is_over():
                self._thread.join(_POLL_S)
                if not self._thread.is_alive():
                    raise StatusError(f"the status service at port {self.port} ended by itself; the log says why")
        finally:
            self.stop()

    def __enter__(self) -> StatusServer:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def _serve(self) -> None:
        try:
            self._server.run(sockets=[self._socket])
        except Exception:
            _logger.exception("the status service at port %d ended", self.port)


def _listen(host: str, port: int) -> socket.socket:
    try:
        return listen(host, port)
    except OSError as error:
        if error.errno == errno.EADDRINUSE:
            reason = f"port {port} of {host} is taken; stop what listens there, or choose another with --port"
        else:
            reason = f"cannot listen at {host!r} port {port}: {error}; name an address of this machine with --host"
        raise StatusError(reason) from None
