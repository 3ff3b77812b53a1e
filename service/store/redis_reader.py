"""Runs read from Redis: a call that Redis does not answer at once has failed."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from redis.exceptions import RedisError, ResponseError

from service.base.errors import DamagedStoreError, UnknownRunError
from service.base.parsing import ParseError, parse_with
from service.store import keys
from service.store.address import RedisAddress
from service.store.models import ACTIVE, Columns, GoalGrid, Record, RunStatus
from service.store.pulse import Pulse, with_clock
from service.store.tail import columns_of, parse_record

TIMEOUT_S = 0.5
_logger = logging.getLogger(__name__)


class RedisReader:
    """The ``RunReader``, which see for errors, of a Redis; for any number of threads at once.

    ``StoreUnavailableError`` is raised after ``TIMEOUT_S`` at the latest.
    """

    def __init__(self, address: RedisAddress) -> None:
        self._address = address
        self._client = address.client(TIMEOUT_S)
        self._pulse = Pulse()

    def runs(self) -> list[RunStatus]:
        """All runs, newest start first; one with a damaged status is left out."""
        with self._errors():
            run_ids = [name.decode(errors="replace") for name in self._client.zrevrange(keys.RUNS, 0, -1)]
            statuses = []
            for run_id, (text, *flags) in zip(run_ids, self._look_up(run_ids), strict=True):
                try:
                    statuses.append(self._status(run_id, text, *flags))
                except (DamagedStoreError, UnknownRunError) as error:
                    _logger.warning("%s", error)
        return sorted(statuses, key=lambda status: status.started, reverse=True)

    def run(self, run_id: str) -> RunStatus:
        """One run."""
        with self._errors():
            ((text, *flags),) = self._look_up([run_id])
            if text is None:
                run_ids = [name.decode(errors="replace") for name in self._client.zrange(keys.RUNS, 0, -1)]
                raise UnknownRunError.of(run_id, self._address, sorted(run_ids))
            return self._status(run_id, text, *flags)

    def metrics(self, run_id: str, *, after_iteration: int = 0) -> list[Record]:
        """The records of iterations above ``after_iteration``, in order."""
        self.run(run_id)  # or raise UnknownRunError
        with self._errors():
            lines = self._client.zrangebyscore(keys.run_key(run_id, "metrics"), f"({after_iteration}", "+inf")
        by_iteration: dict[int, Record] = {}
        for line in lines:
            record = parse_record(line)
            if record is None:
                _logger.warning("%s: passing over what is no record: %r", keys.run_key(run_id, "metrics"), line[:60])
            else:
                by_iteration[int(record["iteration"] or 0)] = record
        return list(by_iteration.values())

    def columns(self, run_id: str, names: Sequence[str] | None) -> Columns:
        """These metrics of all iterations that Redis keeps."""
        return columns_of(self.metrics(run_id), names)

    def sample(self, run_id: str, name: str, number: int) -> list[float | None]:
        """One metric of about ``number`` records, evenly over those that Redis keeps."""
        self.run(run_id)  # or raise UnknownRunError
        key = keys.run_key(run_id, "metrics")
        with self._errors(), self._client.pipeline(transaction=False) as pipe:
            size = self._client.zcard(key)
            for index in sorted({(size - 1) * place // max(1, number - 1) for place in range(number)} if size else ()):
                pipe.zrange(key, index, index)
            records = [parse_record(line[0]) for line in pipe.execute() if line]
        return [record.get(name) for record in records if record is not None]

    def goals(self, run_id: str) -> GoalGrid | None:
        """The newest grid; None before the first."""
        self.run(run_id)  # or raise UnknownRunError
        with self._errors():
            text = self._client.get(keys.run_key(run_id, "goals"))
        try:
            return parse_with(GoalGrid.model_validate_json, text, "grid") if text is not None else None
        except ParseError:
            raise _damaged(keys.run_key(run_id, "goals"), "goal grid") from None

    def request_stop(self, run_id: str) -> None:
        """Ask a run to end after its current iteration; nothing happens if it has ended."""
        if self.run(run_id).state in ACTIVE:
            with self._errors():
                self._client.set(keys.run_key(run_id, "stop"), b"1")

    def ready(self) -> None:
        """Return if Redis answers."""
        with self._errors():
            self._client.ping()

    def _status(self, run_id: str, text: bytes | None, beats: bool, stop: bool) -> RunStatus:
        status = _parse_status(run_id, text)
        status = status.model_copy(update={"stopping": status.state in ACTIVE and (status.stopping or stop)})
        age_s = self._pulse.age_s(run_id, status.heartbeat)
        status = with_clock(status)
        if not status.is_silent(age_s):
            return status
        if beats:
            said = f"its process reaches Redis, and its training has said nothing for {age_s:.0f} s: it hangs"
            return status.suffering("stuck", said)
        said = (
            f"Redis has heard nothing of it for {age_s:.0f} s: its process has ended, is frozen, or does not reach "
            "Redis; once it has ended, --resume goes on from its last checkpoint"
        )
        return status.suffering("silent", said)

    def _look_up(self, run_ids: list[str]) -> Iterator[tuple[bytes | None, bool, bool]]:
        """Status of each run, whether its process reports, and whether it was asked to stop."""
        with self._client.pipeline(transaction=False) as pipe:
            for run_id in run_ids:
                pipe.get(keys.run_key(run_id, "status"))
                pipe.exists(keys.run_key(run_id, "heartbeat"))
                pipe.exists(keys.run_key(run_id, "stop"))
            replies = iter(pipe.execute(raise_on_error=False) if run_ids else [])
        for text in replies:
            if isinstance(text, ResponseError):  # another type: of one run only, the others are well
                text = b""
            elif isinstance(text, Exception):
                raise text
            yield text, bool(next(replies)), bool(next(replies))

    @contextmanager
    def _errors(self) -> Iterator[None]:
        try:
            yield
        except ResponseError as error:
            if "WRONGTYPE" in str(error):
                raise DamagedStoreError(
                    f"Redis at {self._address} has another type of value in a key of tandem's; delete tandem:* there"
                ) from None
            raise self._address.unavailable(error) from None
        except (RedisError, OSError) as error:
            raise self._address.unavailable(error) from None


def _parse_status(run_id: str, text: bytes | None) -> RunStatus:
    key = keys.run_key(run_id, "status")
    if text is None:
        raise UnknownRunError(f"run {run_id} is in {keys.RUNS}, but {key} is missing; start it again")
    try:
        return parse_with(RunStatus.model_validate_json, text, key)
    except ParseError:
        raise _damaged(key, "run's status") from None


def _damaged(key: str, what: str) -> DamagedStoreError:
    return DamagedStoreError(f"{key} in Redis holds no {what}; delete that key, a run writes it anew within seconds")
