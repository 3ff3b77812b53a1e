"""Live reports sent to Redis by a thread of its own: Redis may be slow or away, and the run does not notice."""

from __future__ import annotations

import json
import logging
import time
from collections import deque
from contextlib import suppress
from functools import partial
from threading import Event, Thread

from redis.exceptions import RedisError, WatchError

from service.base.errors import RunTakenError, StoreUnavailableError
from service.base.jsonl import plain
from service.store import address as keys
from service.store.address import Content, RedisAddress, reason_of
from service.store.models import GoalGrid, Record, RunStatus, Trouble

TICK_S = 0.5
"""Time between two messages to Redis; a stop request is noticed within it."""
RETRY_S = 1.0
"""Longest time between two tries to reach it."""
TIMEOUT_S = 2.0
BATCH = 500
KEPT = 100
"""Records that are sent again over a new connection. Redis flushes its file every second, so one that is killed may
forget what it confirmed."""
_logger = logging.getLogger(__name__)


class RedisWriter:
    """Reports of one run to Redis. The run directory decides who runs a run; Redis keeps the newest process's reports.

    One thread consumes what the methods leave behind and produces transactions; it waits for ``TICK_S`` and is
    unblocked by ``close``. Status and grid that were not sent yet are replaced by newer ones, records wait in line.

    Args:
        address: of a Redis, which may go and come.
        run_id: id of the run.
        run: identity of the run, by which runs of the same id are told apart.
        epoch: number of this process among those that ever ran it.
        resumed: or else Redis has to be there now: its address may be mistyped.

    Raises:
        RunTakenError: another run with this id reports to this Redis.
        StoreUnavailableError: of a new run, Redis is not there, or does not let us in.
    """

    def __init__(self, address: RedisAddress, run_id: str, *, run: str, epoch: int, resumed: bool = False) -> None:
        self._address, self._run_id, self._run, self._epoch = address, run_id, run.encode(), epoch
        self._mine, self._key = f"{run}:{epoch}".encode(), partial(keys.run_key, run_id)
        self._connected_anew = Event()
        self._client = address.client(TIMEOUT_S, self._connected_anew.set)
        self._is_known = False
        """Whether Redis has taken this process's epoch."""
        try:
            with address.errors():
                self._introduce()
        except StoreUnavailableError:
            if not resumed:
                raise  # or else the thread tries again, and warns
        self._newest: dict[Content, RunStatus | GoalGrid] = {}
        """Status and grid as they are now."""
        self._there: dict[Content, RunStatus | GoalGrid] = {}
        """Status and grid as Redis has them."""
        self._waiting: list[tuple[int, str]] = []
        """Iterations and texts of records: the run adds them at the end, the thread takes them from the front."""
        self._sent: deque[tuple[int, str]] = deque(maxlen=KEPT)
        self._stop = False
        self._away: tuple[float, str] | None = None
        self._replaced = False
        self._closing = Event()
        self._deadline_s = float("inf")
        self._thread = Thread(target=self._work, name="redis-writer", daemon=True)
        self._thread.start()

    def status(self, status: RunStatus) -> None:
        """Replace what is known about the run."""
        self._newest["status"] = status

    def metrics(self, record: Record) -> None:
        """Append one iteration's metrics; those of it and of later ones, made before the run went back, are dropped."""
        self._waiting.append((int(record["iteration"] or 0), json.dumps(plain(record))))

    def goals(self, grid: GoalGrid) -> None:
        """Replace the grid."""
        self._newest["goals"] = grid

    def stop_requested(self) -> bool:
        """Whether the run was asked to stop since it was started, as of the last message to Redis."""
        return self._stop

    def troubles(self) -> list[Trouble]:
        """Problems at the moment."""
        found, away = list[str](), self._away
        if away is not None:
            since_s = time.monotonic() - away[0]
            found.append(
                f"Redis at {self._address} has taken nothing for {since_s:.0f} s: {away[1]}; "
                f"{len(self._waiting)} records wait for it"
            )
        if self._replaced:
            found.append(
                f"Redis at {self._address} gets nothing more: another process reports there as run {self._run_id}; "
                "give one of the two runs another name"
            )
        return [Trouble("redis", text) for text in found]

    def close(self, timeout_s: float = 2.0) -> None:
        """Send what still waits, for at most about ``timeout_s``."""
        self._deadline_s = time.monotonic() + timeout_s
        self._closing.set()
        self._thread.join(timeout_s + 0.1)  # a call to a hanging Redis may last longer; the thread then dies alone
        if self._pending() and not self._replaced:
            _logger.warning("Redis at %s did not get the end of run %s; its files have it", self._address, self._run_id)

    # --- the thread ---------------------------------------------------------------------------------------------------

    def _work(self) -> None:
        pause_s, ending = 0.0, False
        while not ending or (self._pending() and time.monotonic() < self._deadline_s):
            ending = self._closing.wait(pause_s)
            try:
                self._send()
            except RunTakenError:
                self._replaced = True
                break
            except WatchError:  # another process began in this very moment; the next try tells
                pause_s = 0.0
            except (RedisError, OSError) as error:
                if self._away is None:
                    _logger.warning("Redis at %s: %s; the run goes on", self._address, reason_of(error))
                self._away = (self._away[0] if self._away else time.monotonic(), reason_of(error))
                pause_s = min(2 * pause_s + 0.05, RETRY_S)
                if ending:
                    time.sleep(0.05)
            else:
                if self._away is not None:
                    _logger.info("Redis at %s is back after %.0f s", self._address, time.monotonic() - self._away[0])
                self._away = None
                pause_s = 0.0 if self._waiting else TICK_S
        with suppress(RedisError, OSError):  # it expires by itself
            if not self._replaced:
                self._client.delete(self._key("heartbeat"))
            self._client.close()

    def _introduce(self) -> None:
        """Tell Redis who reports from now on.

        Raises:
            RunTakenError: another run reports under this run id.
        """
        theirs = self._client.get(self._key("epoch")) or self._mine
        if theirs.partition(b":")[0] != self._run and self._client.exists(self._key("heartbeat")):
            raise RunTakenError(
                f"another run with the id {self._run_id} reports to Redis at {self._address}; stop that one (if it has "
                f"ended, wait {keys.HEARTBEAT_S:.0f} s), or name another --run-dir"
            )
        if theirs.partition(b":")[0] == self._run and self._is_newer(theirs):
            raise RunTakenError(self._run_id)
        self._client.set(self._key("epoch"), self._mine)
        self._client.delete(self._key("stop"))
        self._is_known = True

    def _send(self) -> None:
        """Send one transaction.

        Raises:
            RunTakenError: another run, or a newer process of this one, reports under this run id.
        """
        del self._waiting[: -keys.MAX_RECORDS]  # Redis would keep no more of them
        if not self._is_known:
            self._introduce()
        newest, records = dict(self._newest), self._waiting[:BATCH]
        with self._client.pipeline() as pipe:
            pipe.watch(self._key("epoch"))
            if self._is_newer(pipe.get(self._key("epoch"))):
                raise RunTakenError(self._run_id)
            now_s, _ = pipe.time()  # of the clock that all runs share: a wrong one here would make others look old
            pipe.multi()
            pipe.set(self._key("epoch"), self._mine)  # a Redis that lost its data has forgotten it
            pipe.set(self._key("heartbeat"), 1, px=int(1000 * keys.HEARTBEAT_S))
            for content, value in newest.items():
                if value is not self._there.get(content):
                    pipe.set(self._key(content), value.model_dump_json())
                if isinstance(value, RunStatus):
                    pipe.zadd(keys.RUNS, {self._run_id: now_s})
                    pipe.zremrangebyscore(keys.RUNS, "-inf", now_s - keys.KEPT_S)
            key = self._key("metrics")
            for iteration, text in records:
                pipe.zremrangebyscore(key, iteration, "+inf")
                pipe.zadd(key, {text: iteration})
            pipe.zremrangebyrank(key, 0, -keys.MAX_RECORDS - 1)
            for content in keys.EXPIRING:
                pipe.expire(self._key(content), keys.KEPT_S)
            pipe.exists(self._key("stop"))
            self._stop = bool(pipe.execute()[-1])
        self._there = newest
        self._sent.extend(records)
        del self._waiting[: len(records)]
        if self._connected_anew.is_set():  # a Redis that was killed has forgotten what came last
            self._connected_anew.clear()
            self._there = {}
            self._waiting[:0] = self._sent
            self._sent.clear()

    def _is_newer(self, found: bytes | None) -> bool:
        """Whether the process of an epoch in Redis began after this one; one from an older copy of its data did not."""
        run, _, epoch = (found or self._mine).partition(b":")
        return run != self._run or not epoch.isdigit() or int(epoch) > self._epoch

    def _pending(self) -> bool:
        return bool(self._waiting) or self._newest != self._there
