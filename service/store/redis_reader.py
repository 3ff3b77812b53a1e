"""Runs read from Redis: a call that Redis does not answer at once has failed."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from threading import Lock

from typing_extensions import override

from service.base.errors import DamagedStoreError, UnknownRunError
from service.base.parsing import ParseError, parse_with
from service.store.address import KEPT_S, MAX_RECORDS, RUNS, Content, RedisAddress, run_key
from service.store.models import ACTIVE, SILENT_AFTER, Columns, GoalGrid, Pulse, Record, RunReader, RunStatus
from service.store.tail import Table, parse_record

TIMEOUT_S = 0.5
MAX_TABLES = 30
"""Runs whose columns stay in memory; 30,000 iterations of 70 metrics take 17 MB."""
_logger = logging.getLogger(__name__)


class _Cache:
    """Columns of a run, and the text of their last record."""

    def __init__(self) -> None:
        self.table, self.last, self.lock = Table(), b"", Lock()


class RedisReader(RunReader):
    """The runs that report to a Redis; for any number of threads at once.

    ``StoreUnavailableError`` is raised after ``TIMEOUT_S`` at the latest.
    """

    def __init__(self, address: RedisAddress) -> None:
        self._address = address
        self._client = address.client(TIMEOUT_S)
        self._pulse = Pulse()
        self._tables: dict[str, _Cache] = {}
        """By the runs' ids, the one that was asked for last at the end."""
        self._lock = Lock()

    @override
    def runs(self) -> list[RunStatus]:
        """One with a damaged status is left out, and one without: it was removed."""
        statuses = []
        for run_id, text, *flags in self._look_up(self._run_ids()):
            try:
                if text is not None:
                    statuses.append(self._status(run_id, text, *flags))
            except DamagedStoreError as error:
                _logger.warning("%s", error)
        return sorted(statuses, key=lambda status: status.started, reverse=True)

    @override
    def run(self, run_id: str) -> RunStatus:
        ((_, text, *flags),) = self._look_up([run_id])
        if text is None:
            raise UnknownRunError.of(run_id, self._address, sorted(self._run_ids()))
        return self._status(run_id, text, *flags)

    @override
    def metrics(self, run_id: str, *, after_iteration: int = 0, most: int | None = None) -> list[Record]:
        self.run(run_id)  # or raise UnknownRunError
        return list(filter(None, map(parse_record, self._lines(run_id, f"({after_iteration}", most))))

    @override
    def newest(self, run_id: str) -> Record | None:
        self.run(run_id)  # or raise UnknownRunError
        with self._address.errors():
            lines = self._client.zrange(run_key(run_id, "metrics"), -1, -1)
        return parse_record(lines[0]) if lines else None

    @override
    def columns(self, run_id: str, names: Sequence[str] | None) -> Columns:
        """What was read stays in memory, of the ``MAX_TABLES`` runs that were asked for last."""
        self.run(run_id)  # or raise UnknownRunError
        with self._lock:
            cache = self._tables[run_id] = self._tables.pop(run_id, _Cache())
            while len(self._tables) > MAX_TABLES:
                del self._tables[next(iter(self._tables))]
        with cache.lock:
            table, last = cache.table, cache.last
            lines = self._lines(run_id, str(int(table["iteration"][-1])) if last else "-inf")
            is_full = len(table.get("iteration", ())) > 1.5 * MAX_RECORDS  # Redis has dropped the first ones
            if last and (lines[:1] != [last] or is_full):  # or the run went back, or is another one
                table, lines = Table(), self._lines(run_id, "-inf")
            for record in filter(None, map(parse_record, lines)):
                table.add(record)
            cache.table, cache.last = table, lines[-1] if table else b""
            return table.columns(names)

    @override
    def sample(self, run_id: str, name: str, number: int) -> list[float | None]:
        self.run(run_id)  # or raise UnknownRunError
        key = run_key(run_id, "metrics")
        with self._address.errors(), self._client.pipeline(transaction=False) as pipe:
            last = self._client.zcard(key) - 1
            for index in sorted({last * place // max(1, number - 1) for place in range(number)}):
                pipe.zrange(key, index, index)
            records = [parse_record(line[0]) for line in pipe.execute() if line]
        return [record.get(name) for record in records if record is not None]

    @override
    def goals(self, run_id: str) -> GoalGrid | None:
        self.run(run_id)  # or raise UnknownRunError
        with self._address.errors():
            text = self._client.get(run_key(run_id, "goals"))
        try:
            return parse_with(GoalGrid.model_validate_json, text, "grid") if text is not None else None
        except ParseError:
            raise _damaged(run_key(run_id, "goals"), "goal grid") from None

    @override
    def request_stop(self, run_id: str) -> None:
        if self.run(run_id).state in ACTIVE:
            with self._address.errors():
                self._client.set(run_key(run_id, "stop"), b"1", ex=KEPT_S)

    @override
    def ready(self) -> None:
        with self._address.errors():
            self._client.ping()

    def _lines(self, run_id: str, first: str, most: int | None = None) -> list[bytes]:
        """Texts of records whose iteration is at least ``first``; above it with a bracket. At most ``most``."""
        part = {} if most is None else {"start": 0, "num": most}
        with self._address.errors():
            lines: list[bytes] = self._client.zrangebyscore(run_key(run_id, "metrics"), first, "+inf", **part)
        return lines

    def _run_ids(self) -> list[str]:
        with self._address.errors():
            return [name.decode(errors="replace") for name in self._client.zrange(RUNS, 0, -1)]

    def _look_up(self, run_ids: list[str]) -> list[tuple[str, bytes | None, bytes | None, bytes | None]]:
        """Id of each run, its status, the sign that its process reports, and a request to stop."""
        if not run_ids:
            return []
        contents: tuple[Content, ...] = ("status", "heartbeat", "stop")
        with self._address.errors():
            values = self._client.mget([run_key(run_id, content) for run_id in run_ids for content in contents])
        return list(zip(run_ids, values[::3], values[1::3], values[2::3], strict=True))

    def _status(self, run_id: str, text: bytes | None, beats: bytes | None, stop: bytes | None) -> RunStatus:
        try:
            status = parse_with(RunStatus.model_validate_json, text or b"", "status")
        except ParseError:
            raise _damaged(run_key(run_id, "status"), "run's status") from None
        stopping = status.state in ACTIVE and (status.stopping or stop is not None)
        status, age_s = self._pulse.look(status.model_copy(update={"stopping": stopping}))
        if status.state not in ACTIVE or age_s <= SILENT_AFTER.total_seconds():
            return status
        if beats is not None:
            said = f"its process reaches Redis, and its training has said nothing for {age_s:.0f} s: it hangs"
            return status.suffering("stuck", said)
        said = (
            f"Redis has heard nothing of it for {age_s:.0f} s: its process has ended, is frozen, or does not reach "
            "Redis; once it has ended, --resume goes on from its last checkpoint"
        )
        return status.suffering("silent", said)


def _damaged(key: str, what: str) -> DamagedStoreError:
    return DamagedStoreError(f"{key} in Redis holds no {what}; delete that key, a run writes it anew within seconds")
