"""Prometheus metrics of ``/metrics``, read from the runs and the registry at each scrape.

``RUN_METRICS``, ``SERVICE_METRICS`` and ``HTTP_METRICS`` are the reference: names, kinds, labels and meanings. Only
active runs and the newest few that ended have metrics, so the number of series is bounded.
"""

from __future__ import annotations

import logging
from collections import Counter as Count
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Literal, get_args

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, ProcessCollector, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily
from prometheus_client.registry import Collector

from service.base.errors import StorageError, StoreError
from service.registry.registry import Registry
from service.store.models import ACTIVE, CONDITIONS, ActorStatus, Record, RunReader, RunState, RunStatus

CONTENT_TYPE = "text/plain; version=0.0.4; charset=utf-8"
NUM_ENDED_RUNS = 20
FAILURES_S = 3600.0
MAX_ACTIVE_RUNS = 500
_STATES: tuple[RunState, ...] = get_args(RunState)
_ACTOR_STATES: tuple[Literal["starting", "alive"], ...] = get_args(ActorStatus.model_fields["state"].annotation)
_logger = logging.getLogger(__name__)
_Family = CounterMetricFamily | GaugeMetricFamily


@dataclass(frozen=True, slots=True)
class Metric:
    """One metric of the reference; its unit is part of the name, as usual in Prometheus."""

    name: str
    kind: Literal["counter", "gauge", "histogram"]
    labels: tuple[str, ...]
    help: str

    def family(self) -> _Family:
        """Make an empty family to add samples to."""
        family = CounterMetricFamily if self.kind == "counter" else GaugeMetricFamily
        return family(self.name, self.help, labels=self.labels)


@dataclass(frozen=True, slots=True)
class RunMetric(Metric):
    """One number of a run; None if it has none at the moment."""

    value: Callable[[RunStatus, Record], float | None]


def _run(name: str, text: str, value: Callable[[RunStatus, Record], float | None]) -> RunMetric:
    kind: Literal["counter", "gauge"] = "counter" if name.endswith("_total") else "gauge"
    return RunMetric(f"tandem_run_{name}", kind, ("run",), text, value)


def _of_record(name: str, key: str, text: str) -> RunMetric:
    return _run(name, f"{text} ({key}, newest iteration)", lambda _, record: record.get(key))


def _age_s(when: datetime) -> float:
    return (datetime.now(UTC) - when).total_seconds()


def _actor_age_s(run: RunStatus) -> float | None:
    """Of those that have started: others may wait for a core for as long as the run goes on.

    By the run's machine, whose clock may differ from the one here. Compared with each other: while the run measures
    at its end, it asks none of them.
    """
    if run.state not in ACTIVE:
        return None
    beats = [actor.heartbeat for actor in run.actors if actor.state == "alive"]
    return (max(beats) - min(beats)).total_seconds() if beats else None


RUN_METRICS: tuple[RunMetric, ...] = (
    _run("started_timestamp_seconds", "Start of the process that runs it, Unix time",
         lambda run, _: run.started.timestamp()),
    _run("heartbeat_age_seconds", "Seconds since the run's last heartbeat; negative where a clock is wrong",
         lambda run, _: _age_s(run.heartbeat)),
    _run("stopping", "1 while a stop is requested and the run has not ended", lambda run, _: run.stopping),
    _run("warnings", "Number of current warnings, such as Redis being unavailable", lambda run, _: len(run.warnings)),
    _run("iteration", "Finished iterations; falls when the run goes back", lambda run, _: run.iteration),
    _run("env_steps", "Env steps of the run so far; falls when the run goes back", lambda run, _: run.num_env_steps),
    _run("iterations_total", "Iterations, with those made again", lambda run, _: run.totals.iterations),
    _run("env_steps_total", "Env steps, all worlds together, with those made again",
         lambda run, _: run.totals.env_steps),
    _run("env_steps_budget", "Env steps at which the run ends", lambda run, _: run.total_env_steps),
    _run("env_steps_per_second", "Env steps per second, newest iteration", lambda run, _: run.env_steps_per_s),
    _run("policy_version", "Updates of the policies so far", lambda run, _: run.policy_version),
    _run("policy_lag_versions", "Policy versions between acting and learning, mean of the last update",
         lambda run, _: run.policy_lag),
    _run("rollouts_counted_total", "Rollouts learned from, each once", lambda run, _: run.totals.rollouts_counted),
    _run("rollouts_refused_total", "Rollouts seen before, or too old", lambda run, _: run.totals.rollouts_refused),
    _run("actor_replacements_total", "How often an actor, the learner or the generator was replaced",
         lambda run, _: run.totals.replacements),
    _run("actor_heartbeat_age_seconds",
         "Seconds from the oldest heartbeat of the actors that are up to the newest, of an active run",
         lambda run, _: _actor_age_s(run)),
    _of_record("valid_goals_ratio", "alice/valid_fraction", "Fraction of Alice's goals that are valid"),
    _of_record("lifted_goals_ratio", "alice/lifted_fraction", "Fraction of valid goals that are in the air"),
    _of_record("bob_success_ratio", "bob/success_rate", "Fraction of valid goals that Bob reached"),
    _of_record("bob_success_air_ratio", "bob/success_rate_air", "Fraction of valid goals in the air that Bob reached"),
    _of_record("learner_idle_ratio", "time/learner_idle_fraction",
               "Fraction of the wall time in which the learner waits for rollouts"),
    _of_record("learn_seconds", "time/learn_s", "Seconds of learning in one iteration"),
    _of_record("non_finite_steps", "learner/non_finite_steps", "Gradient steps skipped because they were not finite"),
    _of_record("rollbacks", "learner/rollbacks", "Players reset to their state before the update"),
    _of_record("broken_worlds", "world/num_broken", "Worlds whose physics diverged"),
    _of_record("goal_cells", "generator/num_cells_seen", "Cells of the grid with a valid goal of an object so far"),
)  # fmt: skip
"""Metrics with one sample for each run."""

_RUN_INFO = Metric("tandem_run_info", "gauge", ("run", "name", "runtime"), "1; a run's primitives and its runtime")
_RUN_STATE = Metric("tandem_run_state", "gauge", ("run", "state"), "1 for the state a run is in, 0 for the others")
_RUN_CONDITION = Metric(
    "tandem_run_condition", "gauge", ("run", "condition"), "1 for the worst that an active run suffers from"
)
_RUN_ACTORS = Metric("tandem_run_actors", "gauge", ("run", "state"), "Actors, learner and generator of an active run")
_RUNS = Metric("tandem_runs", "gauge", ("state",), "Number of runs by state")
_STORE_UP = Metric("tandem_store_up", "gauge", (), "1 if the runs could be read for this answer")
_REGISTRY_UP = Metric("tandem_registry_up", "gauge", (), "1 if the registry could be read for this answer")
_VERSIONS = Metric("tandem_registry_versions", "gauge", ("name",), "Published versions")
_ALIAS = Metric("tandem_registry_alias_version", "gauge", ("name", "alias"), "The version an alias means")
SERVICE_METRICS: tuple[Metric, ...] = (
    _RUN_INFO, _RUN_STATE, _RUN_CONDITION, _RUN_ACTORS, _RUNS, _STORE_UP, _REGISTRY_UP, _VERSIONS, _ALIAS,
)  # fmt: skip
"""The other metrics that are read at each scrape."""

_REQUESTS = Metric("tandem_http_requests_total", "counter", ("method", "route", "status"), "Answered requests")
_DURATION = Metric("tandem_http_request_duration_seconds", "histogram", ("route",), "Seconds until an answer begins")
_STREAMS = Metric("tandem_http_streams", "gauge", (), "Open event streams")
HTTP_METRICS: tuple[Metric, ...] = (_REQUESTS, _DURATION, _STREAMS)
"""Metrics that the service counts itself; prometheus-client adds ``tandem_process_...``."""
_METHODS = frozenset({"GET", "HEAD", "POST", "PUT", "DELETE"})
_BUCKETS = (0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 10.0)


class Telemetry(Collector):
    """The metrics of one app, in their own Prometheus registry; nothing is read before the first ``page``."""

    def __init__(self, runs: RunReader, registry: Registry, num_streams: Callable[[], int]) -> None:
        self._runs, self._registry = runs, registry
        self._all = all_ = CollectorRegistry()
        all_.register(self)
        ProcessCollector(namespace="tandem", registry=all_)
        self._requests = Counter(_REQUESTS.name, _REQUESTS.help, _REQUESTS.labels, registry=all_)
        self._duration = Histogram(_DURATION.name, _DURATION.help, _DURATION.labels, registry=all_, buckets=_BUCKETS)
        Gauge(_STREAMS.name, _STREAMS.help, registry=all_).set_function(num_streams)

    def observe(self, method: str, route: str, status: int, duration_s: float) -> None:
        """Count one answer; ``route`` is the template, not the path, so that clients cannot create series."""
        self._requests.labels(method if method in _METHODS else "other", route, str(status)).inc()
        self._duration.labels(route).observe(duration_s)

    def page(self) -> bytes:
        """Make the text of a scrape, of ``CONTENT_TYPE``; what cannot be read at the moment is left out."""
        return generate_latest(self._all)

    def collect(self) -> Iterator[_Family]:
        """Read the runs and the registry; prometheus-client calls it at each scrape."""
        yield from self._about_runs()
        yield from self._about_registry()

    def _about_runs(self) -> Iterator[_Family]:
        up = _STORE_UP.family()
        try:
            runs = self._runs.runs()
        except StoreError as error:
            _logger.warning("/metrics has no run: %s", error)
            up.add_metric([], 0)
            yield up
            return
        up.add_metric([], 1)
        yield up
        count = Count(run.state for run in runs)
        by_state = _RUNS.family()
        for state in _STATES:
            by_state.add_metric([state], count[state])
        yield by_state
        yield from _families([(run, self._newest_record(run)) for run in shown(runs)])

    def _newest_record(self, run: RunStatus) -> Record:
        try:
            return self._runs.newest(run.run_id) or {}
        except StoreError:  # such as a run that was deleted just now
            return {}

    def _about_registry(self) -> Iterator[_Family]:
        up, versions, aliases = _REGISTRY_UP.family(), _VERSIONS.family(), _ALIAS.family()
        try:
            names = self._registry.names()
        except (StorageError, OSError) as error:
            _logger.warning("/metrics has no name of the registry: %s", error)
            up.add_metric([], 0)
            yield up
            return
        up.add_metric([], 1)
        for name in names:
            try:
                versions.add_metric([name], len(self._registry.versions(name)))
                for alias, number in self._registry.aliases(name).items():
                    aliases.add_metric([name, alias], number)
            except (StorageError, OSError) as error:  # must not hide the other names
                _logger.warning("/metrics has not all of %s in the registry: %s", name, error)
        yield from (up, versions, aliases)


def shown(runs: list[RunStatus]) -> list[RunStatus]:
    """Select ``MAX_ACTIVE_RUNS`` active runs, those in the worst condition, and the last ``NUM_ENDED_RUNS`` that ended.

    Of the latter those that failed or were interrupted within ``FAILURES_S`` come first: their alerts need them for
    minutes.
    """
    active = [run for run in runs if run.state in ACTIVE]
    active.sort(key=lambda run: CONDITIONS.index(run.condition), reverse=True)  # no alert without metrics
    # Not by their start, by which they are listed: a long run that failed just now would be gone before its alert.
    ended = sorted((run for run in runs if run.state not in ACTIVE), key=_urgency, reverse=True)
    return active[:MAX_ACTIVE_RUNS] + ended[:NUM_ENDED_RUNS]


def _urgency(run: RunStatus) -> tuple[bool, datetime]:
    return run.state in ("failed", "interrupted") and _age_s(run.heartbeat) < FAILURES_S, run.heartbeat


def _families(runs: list[tuple[RunStatus, Record]]) -> Iterator[_Family]:
    info, states, actors = _RUN_INFO.family(), _RUN_STATE.family(), _RUN_ACTORS.family()
    conditions = _RUN_CONDITION.family()
    for run, _ in runs:
        info.add_metric([run.run_id, run.name, run.runtime], 1)
        for state in _STATES:
            states.add_metric([run.run_id, state], run.state == state)
        for condition in CONDITIONS if run.state in ACTIVE else ():
            conditions.add_metric([run.run_id, condition], run.condition == condition)
        count = Count(actor.state for actor in run.actors)
        for actor_state in _ACTOR_STATES if run.actors and run.state in ACTIVE else ():
            actors.add_metric([run.run_id, actor_state], count[actor_state])
    yield from (info, states, conditions, actors)
    for metric in RUN_METRICS:
        family = metric.family()
        for run, record in runs:
            value = metric.value(run, record)
            if value is not None:
                family.add_metric([run.run_id], value)
        yield family
