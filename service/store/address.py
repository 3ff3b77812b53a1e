"""Redis: its address, which keeps its password out of every log, and the keys that tandem uses there.

| key | type | content |
|---|---|---|
| ``tandem:runs`` | sorted set | run ids by when they last reported, in seconds since 1970 |
| ``tandem:run:ID:status`` | string | ``RunStatus`` as JSON |
| ``tandem:run:ID:metrics`` | sorted set | records as JSON by iteration, the newest ``MAX_RECORDS`` |
| ``tandem:run:ID:goals`` | string | ``GoalGrid`` as JSON |
| ``tandem:run:ID:stop`` | string | is there when the run was asked to stop |
| ``tandem:run:ID:heartbeat`` | string, expires | is there until ``HEARTBEAT_S`` after its process last reported |
| ``tandem:run:ID:epoch`` | string | ``RUN:EPOCH``: identity of the run and number of the process that reports |

A run's keys go ``KEPT_S`` after its last report, and so does its id.

Records are in a sorted set and no stream: written twice, as after an answer that got lost, a record is there once, and
a resumed run's takes the place of the earlier one.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, Literal
from urllib.parse import urlsplit

from service.base.errors import StoreError, StoreUnavailableError, needs_extra

VARIABLE = "TANDEM_REDIS_URL"
RUNS = "tandem:runs"
Content = Literal["status", "metrics", "goals", "stop", "heartbeat", "epoch"]
MAX_RECORDS = 20_000
"""Of one run, about 70 MB; ``metrics.jsonl`` has them all."""
HEARTBEAT_S = 10.0
EXPIRING: Sequence[Content] = ("status", "metrics", "goals", "epoch")
KEPT_S = 30 * 86_400
"""Else a Redis with bounded memory is full once some runs have ended; their directories have all of it."""
_FORM = "redis://[[USER]:PASSWORD@]HOST[:PORT][/DB], with %-escapes for other characters than letters and digits"


@dataclass(frozen=True, slots=True)
class RedisAddress:
    """The URL of a Redis; as text it has no password.

    Raises:
        StoreError: not a Redis URL; the message does not quote it. Or the package redis is not installed.
    """

    url: str = field(repr=False)
    """With the password: for a client, never for people."""

    def __post_init__(self) -> None:
        with needs_extra("cluster", f"a run reports to Redis, since {VARIABLE} is set, and that"):
            from redis.connection import parse_url
        try:
            parse_url(self.url)  # type: ignore[no-untyped-call]
            usable = bool(urlsplit(self.url).hostname or urlsplit(self.url).scheme == "unix")
        except ValueError:
            usable = False
        if not usable:  # from None, and no quotation: a "/" in a password makes parts of it look like the port
            raise StoreError(f"{VARIABLE} is no Redis URL (not shown, for its password); write {_FORM}") from None

    def __str__(self) -> str:
        parts = urlsplit(self.url)
        if parts.scheme == "unix":
            return f"unix://{parts.path}"
        host = f"[{parts.hostname}]" if ":" in (parts.hostname or "") else parts.hostname
        return f"{parts.scheme}://{host}:{parts.port or 6379}{parts.path}"

    def client(self, timeout_s: float, on_connect: Callable[[], None] = lambda: None) -> Any:
        """A ``redis.Redis``, annotated as Any: redis-py's annotations name the returns of all its modes at once.

        Args:
            timeout_s: after which a call has failed. It is not tried again: callers know better when to.
            on_connect: called after every new connection, which redis-py also makes without a word.
        """
        import redis
        from redis.backoff import NoBackoff
        from redis.retry import Retry

        def connected(connection: Any) -> None:
            connection.on_connect()
            on_connect()

        return redis.Redis.from_url(
            self.url,
            socket_timeout=timeout_s,
            socket_connect_timeout=timeout_s,
            retry=Retry(NoBackoff(), 0),
            redis_connect_func=connected,
            protocol=2,  # one shape of replies, whatever redis-py makes the default
        )

    @contextmanager
    def errors(self) -> Iterator[None]:
        """Turn a client's error of the block into one line for the user.

        Raises:
            StoreUnavailableError: Redis does not answer, does not let us in, or refuses what was asked.
        """
        from redis.exceptions import RedisError

        try:
            yield
        except (RedisError, OSError) as error:
            reason = reason_of(error)
            raise StoreUnavailableError(f"Redis at {self}: {reason}; check {VARIABLE} and the server") from None


def run_key(run_id: str, content: Content) -> str:
    """Key of one value of a run."""
    return f"tandem:run:{run_id}:{content}"


def address_from_environment() -> RedisAddress | None:
    """The Redis of ``TANDEM_REDIS_URL``; None where it is not set or empty; see `RedisAddress` for errors."""
    url = os.environ.get(VARIABLE, "").strip()
    return RedisAddress(url) if url else None


def reason_of(error: Exception) -> str:
    """A client's error in one line that names no password."""
    from redis import exceptions

    text = " ".join(str(error).split()) or type(error).__name__
    refused = isinstance(error, (exceptions.AuthenticationError, exceptions.AuthorizationError))
    if refused or "NOAUTH" in text or "WRONGPASS" in text:
        return "wrong or missing password"
    if isinstance(error, (exceptions.TimeoutError, TimeoutError)):
        return "no answer in time"
    return text.rstrip(".")
