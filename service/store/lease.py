"""A claim on a run: a key in Redis that its holder renews, and that expires when the holder is gone.

It may expire while its holder is only frozen. So each claim has a number, the epoch, one above the last one's, and
every message of a driver is a transaction that fails once there is a higher one: a fencing token.
"""

from __future__ import annotations

import json
import os
import secrets
import socket
import time
from datetime import UTC, datetime
from typing import Any

from service.io.errors import RunTakenError
from service.parsing import parse_json
from service.store import keys

_POLL_S = 0.1


class Lease:
    """One driver's claim on a run id; nobody has it before `acquire`.

    Every method raises ``redis.exceptions.RedisError`` while Redis is away.

    Args:
        client: of the Redis; see ``RedisAddress.client``.
        run_id: what is claimed.
        duration_s: how long it lives after its last renewal.
    """

    def __init__(self, client: Any, run_id: str, duration_s: float = keys.LEASE_S) -> None:
        self._client, self._run_id, self._key = client, run_id, keys.run_key(run_id, "lease")
        self._epoch_key, self._epoch = keys.run_key(run_id, "epoch"), 0
        self._duration_ms = int(1000 * duration_s)
        now = datetime.now(UTC).isoformat(timespec="seconds")
        holder = {"token": secrets.token_hex(16), "host": socket.gethostname(), "pid": os.getpid(), "since": now}
        self._mine = json.dumps(holder).encode()

    def acquire(self) -> None:
        """Claim the run; waits for the claim of a driver that died to expire.

        Raises:
            RunTakenError: another driver renews its claim.
        """
        previous_ms, deadline_s = None, time.monotonic() + 1.5 * self._duration_ms / 1000
        while not self._client.set(self._key, self._mine, nx=True, px=self._duration_ms):
            left_ms = self._client.pttl(self._key)
            renewed = previous_ms is not None and left_ms > previous_ms  # only the living do
            if renewed or time.monotonic() > deadline_s:
                raise RunTakenError(
                    f"run {self._run_id} is being run by {_describe(self._client.get(self._key))}; stop that one, or "
                    "give this run another id"
                )
            previous_ms = left_ms
            time.sleep(_POLL_S)
        self._epoch = int(self._client.incr(self._epoch_key))

    def renew(self, pipe: Any) -> None:
        """Begin a transaction, on a fresh pipe, that renews the claim and fails where another has taken it meanwhile.

        A claim that has expired, as after an outage, is made again, unless another driver had one meanwhile.

        Raises:
            RunTakenError: another driver has it, or had it.
        """
        pipe.watch(self._key, self._epoch_key)
        holder, epoch = pipe.get(self._key), pipe.get(self._epoch_key)
        if holder not in (None, self._mine):
            raise RunTakenError(f"run {self._run_id} was taken over by {_describe(holder)}")
        if epoch is not None and not (epoch.isdigit() and int(epoch) <= self._epoch):
            raise RunTakenError(f"run {self._run_id} was taken over by another process, which has ended since")
        pipe.multi()
        pipe.set(self._key, self._mine, px=self._duration_ms)
        pipe.set(self._epoch_key, self._epoch)  # a Redis that lost its data has forgotten it

    def release(self) -> None:
        """Give the claim up, if it is ours; after an error it expires by itself."""
        with self._client.pipeline() as pipe:
            pipe.watch(self._key)
            if pipe.get(self._key) == self._mine:
                pipe.multi()
                pipe.delete(self._key)
                pipe.execute()


def _describe(holder: object) -> str:
    try:
        tree = parse_json(holder if isinstance(holder, bytes) else b"", "the lease")
        return f"process {int(tree['pid'])} on {str(tree['host'])[:100]} since {str(tree['since'])[:30]}"
    except (ValueError, KeyError, TypeError):
        return "another process"
