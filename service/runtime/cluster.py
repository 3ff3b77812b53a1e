"""The cluster runner: the parts of the local runner as Ray actors, and a driver that loses none of them.

The driver holds references, not data. It gives an actor the newest weights and an assignment, gives the rollout that
comes back to the learner and its records to the task generator, and gives the new weights out. Learner and generator
hand back their whole state with every iteration, so when one dies, another goes on from there with the rollouts in
hand: what an actor handed over is neither lost nor counted twice.
"""

from __future__ import annotations

import logging
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
import ray
from ray.exceptions import ObjectLostError, RayActorError, RayError, RayTaskError

from service.actors.rollout import from_arrays
from service.config import Config
from service.errors import DivergedError
from service.io.run_directory import RunDirectory
from service.policies.parameters import Parameters, PolicyError
from service.runtime.actor_pool import QUIET, THREAD_VARIABLES, Crew, Member
from service.runtime.bookkeeping import Books
from service.runtime.ray_connection import ClusterOptions
from service.runtime.remote_worker import Stateful, one_line
from service.runtime.runner import (
    EVALUATED_GOALS,
    EVALUATION_SEED,
    ClusterError,
    Health,
    Metrics,
    OnBeat,
    OnIteration,
    RunResult,
)
from service.runtime.slots import RolloutSlots
from service.runtime.timing import Timing
from service.runtime.workers import GeneratorGoneError, GeneratorWorker, LearnerWorker, Recorded, Round, Updated
from service.store.models import GoalGrid

_logger = logging.getLogger(__name__)

POLL_S = 0.2
"""At least so often the driver looks at stop requests, deadlines and who is new."""
BEAT_S = 1.0
"""Between two signs of life."""
RESIZE_S = 5.0
"""Between two looks at the size of the cluster."""
MAX_ATTEMPTS = 3
"""So many learners or generators in a row may die of the same iteration."""
MAX_FAILED_ROUNDS = 20
"""So many rounds in a row may fail."""


@dataclass(frozen=True, slots=True)
class Handed:
    """A rollout that an actor handed over."""

    ticket: int
    rollout: Any
    """Reference to it."""
    records: Any
    """Reference to its records."""
    weights: Any
    """Reference to those it was played with."""
    numbers: Round
    hand_over_s: float
    """From giving the round until its end was noticed, without playing it: all that was on its way or in line."""


@dataclass(slots=True)
class Iteration:
    """One on its way through the learner and the task generator, which work on it side by side."""

    batch: list[Handed]
    num_attempts: Counter[str] = field(default_factory=Counter)
    """Failed ones, by worker."""
    weights: Any = None
    """Reference to the version that comes out of it."""
    states: dict[str, Any] = field(default_factory=dict)
    """References to the workers' states after it, by worker."""
    updated: Updated | None = None
    recorded: Recorded | None = None

    @property
    def num_env_steps(self) -> int:
        """Of its rollouts."""
        return sum(each.numbers.num_env_steps for each in self.batch)


class ClusterRun:
    """A pre-training run on the Ray cluster that this process is connected to.

    One loop, ``run``: it consumes what actors, learner and generator finish, and starts what can start. It waits for
    the next of them to finish, at most ``POLL_S``.

    Args:
        config: the run. Its ``game.num_worlds`` are shared out among the actors there are at the start.
        directory: where it keeps everything.
        options: of the cluster.
        resume: continue from the newest checkpoint, whichever runner and however many actors wrote it.

    Raises:
        CheckpointError: ``resume`` without a usable checkpoint.
        ClusterError: learner or generator do not come up.
    """

    def __init__(
        self,
        config: Config,
        directory: RunDirectory,
        options: ClusterOptions,
        *,
        resume: bool = False,
    ) -> None:
        self.config, self.directory = config, directory
        self.books = Books(config, directory)
        self.timing = Timing()
        self._options = options
        self._stop_requested = self._converged = False
        self._waiting: dict[Any, Callable[[Any], None]] = {}
        self._slots = RolloutSlots()
        self._handed: list[Handed] = []
        self._current: Iteration | None = None
        self._evaluated: Metrics = {}
        self._grid: GoalGrid | None = None
        self._num_failed_rounds = self._num_counted = self._num_refused = 0
        self._last_error: str | None = None
        learner_state = generator_state = pending = None
        first_incarnation = 0
        if resume:
            parts, meta = self.books.resume()
            learner_state, generator_state = parts["learner"], parts["generator"]
            pending = from_arrays(parts["pending"]) if "pending" in parts else None
            first_incarnation = int(meta.get("next_incarnation", 1))
        self._next_incarnation = first_incarnation + 1
        self._learner = self._make_learner(learner_state, pending)
        self._generator = self._make_generator(generator_state)
        self._learner.up()
        self._generator.up()
        self._weights, self._learner.state = self._learner.handle.begin.options(num_returns=2).remote()
        self._generator.state = self._generator.handle.begin.remote()
        self._version: int = ray.get(self._weights).version
        num = self._num_seats()
        self._num_worlds = -(-config.game.num_worlds // num)
        game = config.game.model_copy(update={"num_worlds": self._num_worlds})
        self._crew = Crew(config.model_copy(update={"game": game}), options.actor_threads, first_incarnation)
        for member in self._crew.resize(num):
            self._expect(member)
        after = {"after_iteration": self.books.iteration, "after_env_steps": self.books.num_env_steps} if resume else {}
        directory.start(config, **after)
        if not resume:
            self._save()  # so that a run killed before its first interval can be resumed, too
            self._take_snapshot(after=-1)
        self._turned = self._beat = self._resized = time.monotonic()

    def request_stop(self) -> None:
        """End within a second, with a checkpoint of the last iteration. Safe to call from a signal handler."""
        self._stop_requested = True

    def bob(self) -> Parameters:
        """The newest Bob, as he is evaluated and published."""
        parameters: Parameters = ray.get(self._weights).bob_ema
        return parameters

    def run(self, on_iteration: OnIteration = lambda metrics: None, on_beat: OnBeat = lambda: None) -> RunResult:
        """Play, learn, record, until the budget is spent, the stop criterion holds, or a stop is requested.

        Raises:
            DivergedError: a policy has.
            ClusterError: rounds, or workers, keep failing.
            UnsavedError: the last checkpoint could not be written; earlier ones that could not are only warned of.
        """
        self._on_iteration = on_iteration
        while (reason := self._over()) is None:
            self._start_iteration()
            self._begin_rounds()
            with self.timing("wait"):
                ready, _ = ray.wait(list(self._waiting), timeout=POLL_S)
            with self.books.diverging():
                for reference in ready:
                    self._waiting.pop(reference)(reference)
            self._look_after()
            if time.monotonic() - self._beat >= BEAT_S:
                self._beat = time.monotonic()
                on_beat()
        with self.books.saving_last(), self.timing("checkpoint"):
            if not self.books.saved:
                self._save()
        return RunResult(reason, self.books.iteration, self.books.num_env_steps)

    def health(self) -> Health:
        """Of all its workers."""
        waiting = self._crew.num_waiting
        lack = (f"{waiting} of {len(self._crew)} rollout actors wait for a free core",) if waiting else ()
        actors = (*(each.status() for each in self._crew), self._learner.status(), self._generator.status())
        return Health(actors, self._num_counted, self._num_refused, lack, self._last_error)

    def grid(self) -> GoalGrid:
        """What the task generator knew after the last iteration."""
        assert self._grid is not None
        return self._grid

    def close(self) -> None:
        """End all workers."""
        self._crew.close()
        self._learner.close()
        self._generator.close()

    def _over(self) -> str | None:
        if self._stop_requested:
            return "interrupted"
        if self.books.budget_spent:
            return "finished"
        return "converged" if self._converged else None

    # --- rounds ----------------------------------------------------------------------------------------------------

    def _begin_rounds(self) -> None:
        """Give every idle actor a round, as far as there are slots."""
        for member in self._crew:
            if member.idle and self._slots.may_begin(self._crew.num_counted_on):
                self._begin_round(member)

    def _begin_round(self, member: Member) -> None:
        ticket = self._slots.begin(self._version)
        generator = self._generator.handle
        assignment = generator.assign.remote(self._num_worlds, member.rng, member.pool_version)
        play = member.handle.play.options(num_returns=4)
        rollout, records, rng, numbers = play.remote(self._weights, assignment, generator)
        member.begin(ticket)
        made = partial(Handed, ticket, rollout, records, self._weights)
        self._waiting[numbers] = partial(self._end_round, member, ticket, made, rng)

    def _end_round(self, member: Member, ticket: int, made: Callable[..., Handed], rng: Any, numbers: Any) -> None:
        if not self._crew.holds(member):
            return  # it was given up meanwhile, and its slot with it
        try:
            played: Round = ray.get(numbers)
        except Exception as error:  # whatever happened on another machine
            self._fail_round(member, ticket, error)
            return
        self._num_failed_rounds = 0
        member.finish(played, rng)
        self._crew.took(played.play_s)
        self._slots.finish(ticket)
        self._handed.append(made(played, time.monotonic() - member.began - played.play_s))
        self.directory.dump_broken("-".join(map(str, played.id)), played.broken)

    def _fail_round(self, member: Member, ticket: int, error: Exception) -> None:
        """The actor died, or the generator on which it waited, or the physics threw: who is not well is replaced."""
        if isinstance(error, (DivergedError, PolicyError)):
            raise error
        self._slots.lose(ticket)
        self._num_failed_rounds += 1
        why = one_line(error)
        if self._num_failed_rounds > MAX_FAILED_ROUNDS:
            raise ClusterError(f"{self._num_failed_rounds} rounds in a row failed, the last one with: {why}") from error
        if self._current is None and not self._generator.alive:  # else its iteration notices
            self._generator.restart(why)
        # What the generator was to give an actor fails as that one's round, too.
        if isinstance(error, GeneratorGoneError) or (isinstance(error, RayActorError) and member.answers()):
            member.give_up()
        else:
            self._replace(member, why)

    def _replace(self, member: Member, why: str) -> None:
        _logger.warning("rollout actor %d is gone (%s); another takes its place", member.index, why)
        self._last_error = f"rollout-{member.index}: {why}"
        self._expect(self._crew.replace(member, why))

    def _expect(self, member: Member) -> None:
        """Wait for an actor to come up."""
        self._next_incarnation = max(self._next_incarnation, member.incarnation + 1)
        place, rng = member.handle.ping.options(num_returns=2).remote()
        self._waiting[place] = partial(self._join, member, rng)

    def _join(self, member: Member, rng: Any, place: Any) -> None:
        if not self._crew.holds(member):
            return
        try:
            member.joined(ray.get(place), rng)
        except RayError as error:
            self._num_failed_rounds += 1
            if self._num_failed_rounds > MAX_FAILED_ROUNDS:
                raise ClusterError(f"rollout actors do not come up: {one_line(error)}") from error
            self._replace(member, one_line(error))

    # --- iterations ------------------------------------------------------------------------------------------------

    def _start_iteration(self) -> None:
        """Give learner and generator what was played, if it is enough and makes no round being played too old."""
        num = self._crew.num_counted_on
        if self._current is not None or len(self._handed) < num or not self._slots.may_update(self._version):
            return
        batch, self._handed = self._handed, []  # all: one that were left over would only get older
        self._current = Iteration(batch)
        self._ask_generator(self._current)
        self._ask_learner(self._current)

    def _ask_learner(self, iteration: Iteration) -> None:
        update = self._learner.handle.update.options(num_returns=3)
        iteration.weights, state, updated = update.remote([each.rollout for each in iteration.batch])
        iteration.states["learner"] = state
        self._waiting[updated] = partial(self._answered, iteration, self._learner)

    def _ask_generator(self, iteration: Iteration) -> None:
        num_env_steps = self.books.num_env_steps + iteration.num_env_steps
        records = [each.records for each in iteration.batch]
        record = self._generator.handle.record.options(num_returns=2)
        weights = iteration.batch[0].weights  # who played may become past opponents
        recorded, state = record.remote(self.books.iteration, num_env_steps, weights, records)
        iteration.states["generator"] = state
        self._waiting[recorded] = partial(self._answered, iteration, self._generator)

    def _answered(self, iteration: Iteration, worker: Stateful, reference: Any) -> None:
        try:
            answer = ray.get(reference)
        except RayError as error:
            self._unanswered(iteration, worker, error)
            return
        worker.heard()
        if isinstance(answer, Updated):
            iteration.updated = answer
        else:
            iteration.recorded = answer
        if iteration.updated is not None and iteration.recorded is not None:
            self._finish_iteration(iteration, iteration.updated, iteration.recorded)

    def _unanswered(self, iteration: Iteration, worker: Stateful, error: RayError) -> None:
        """Another learner or generator, from the state before the iteration, and what is left of the iteration."""
        if isinstance(error, RayTaskError) and isinstance(error.cause, ObjectLostError):
            self._drop_lost(iteration)
        elif isinstance(error, (DivergedError, PolicyError)) or worker.alive:
            raise error
        else:
            worker.restart(one_line(error))
            self._last_error = f"{worker.name}: {one_line(error)}"
        iteration.num_attempts[worker.name] += 1
        if iteration.num_attempts[worker.name] >= MAX_ATTEMPTS:
            raise ClusterError(
                f"{MAX_ATTEMPTS} times in a row the {worker.name} failed at the same rollouts, at last with: "
                f"{one_line(error)}"
            ) from error
        if not iteration.batch:
            self._current = None
        elif worker is self._learner:
            self._ask_learner(iteration)
        else:
            self._ask_generator(iteration)

    def _drop_lost(self, iteration: Iteration) -> None:
        """Forget rollouts that were lost with the node that held them."""
        for each in list(iteration.batch):
            try:
                ray.get([each.rollout, each.records])
            except RayError as error:
                _logger.warning("rollout %s is lost (%s)", each.numbers.id, one_line(error))
                iteration.batch.remove(each)
                self._slots.lose(each.ticket)

    def _finish_iteration(self, iteration: Iteration, updated: Updated, recorded: Recorded) -> None:
        """The new version is out: count, record, and hand its slots back."""
        now = time.monotonic()
        elapsed_s, self._turned = now - self._turned, now
        before = self.books.num_env_steps
        self._weights, self._version = iteration.weights, updated.version
        self._learner.state, self._generator.state = iteration.states["learner"], iteration.states["generator"]
        self._slots.publish([each.ticket for each in iteration.batch])
        self._current = None
        self._num_counted += len(updated.counted)
        self._num_refused += len(updated.refused)
        self._converged, self._grid = recorded.should_stop, recorded.grid
        self.books.count(iteration.num_env_steps)
        self.books.wall_s += elapsed_s
        metrics = {
            "iteration": self.books.iteration,
            "env_steps": self.books.num_env_steps,
            **_mean_metrics(iteration.batch),
            **recorded.metrics,
            **updated.metrics,
            "actor/num_rollouts": float(len(iteration.batch)),
            "actor/num_alive": float(sum(member.place is not None for member in self._crew)),
            "time/learner_idle_fraction": max(0.0, 1.0 - updated.update_s / elapsed_s),
            "time/learn_s": updated.update_s,
            "time/wall_s": self.books.wall_s,
            "time/env_steps_per_s": iteration.num_env_steps / elapsed_s,
            **self._evaluated,
        }
        self._evaluated = {}
        with self.timing("record"):
            self.directory.record(metrics)
            self.directory.record_goals(self.books.iteration - 1, self.books.num_env_steps, recorded.sample)
            self._on_iteration(metrics)
        with self.books.going_on("without this snapshot"):
            self._take_snapshot(after=before)
        if self.books.save_due:
            with self.books.going_on(f"and saves again after {self.config.run.checkpoint_interval} iterations"):
                self._save()
        if self.books.evaluation_due:
            self._evaluate()

    def _evaluate(self) -> None:
        """Ask actors for it, each for one kind of goals; what they find is in the record of a later iteration."""
        members = [member for member in self._crew if member.place is not None]
        for index, kind in enumerate(EVALUATED_GOALS[: 3 if members else 0]):
            member = members[index % len(members)]
            self._waiting[member.handle.evaluate.remote(self._weights, kind, EVALUATION_SEED)] = self._take_evaluation

    def _take_evaluation(self, reference: Any) -> None:
        try:
            self._evaluated |= ray.get(reference)
        except RayError as error:
            _logger.warning("without this evaluation: %s", one_line(error))

    # --- looking after ---------------------------------------------------------------------------------------------

    def _look_after(self) -> None:
        """Replace who hangs, follow the cluster's size."""
        for member in self._crew.hung():
            assert member.ticket is not None
            self._slots.lose(member.ticket)
            self._replace(member, f"no rollout for {self._crew.deadline_s:.0f} s")
        now = time.monotonic()
        if now - self._resized >= RESIZE_S:
            self._resized = now
            for member in self._crew.resize(self._num_seats()):
                self._expect(member)

    def _num_seats(self) -> int:
        if self._options.num_actors is not None:
            return self._options.num_actors
        cores = ray.cluster_resources().get("CPU", 0.0) - self._options.learner_cpus
        return max(1, int(cores // self._options.actor_threads))

    # --- saving ----------------------------------------------------------------------------------------------------

    def _save(self) -> None:
        """Write a checkpoint of the last iteration; rounds being played are no part of it, nor who plays them."""
        with self.timing("checkpoint"):
            weights = ray.get(self._weights)
            parts = {"learner": ray.get(self._learner.state), "generator": ray.get(self._generator.state)}
            parts |= {"alice": weights.alice, "bob": weights.bob_ema}  # for readers without torch
            rng = np.random.default_rng([self.config.seed, self.books.iteration])  # what a local runner goes on with
            meta = {"next_incarnation": self._next_incarnation, "rng": rng.bit_generator.state}
            self.books.save(parts, meta)

    def _take_snapshot(self, *, after: int) -> None:
        if self.books.snapshot_due(after=after):
            self.books.take_snapshot(self.bob())

    def _make_learner(self, *arguments: Any) -> Stateful:
        actor = ray.remote(LearnerWorker).options(
            num_cpus=self._options.learner_cpus,
            num_gpus=num_gpus(self.config.learner.device),
            runtime_env={"env_vars": THREAD_VARIABLES},
            **QUIET,
        )
        return Stateful("learner", actor, self.config, *arguments)

    def _make_generator(self, state: Any) -> Stateful:
        actor = ray.remote(GeneratorWorker).options(num_cpus=0, runtime_env={"env_vars": THREAD_VARIABLES}, **QUIET)
        return Stateful("generator", actor, self.config, state)


def _mean_metrics(batch: list[Handed]) -> Metrics:
    """Of the rounds' own metrics, weighted by their worlds, and how many worlds broke."""
    weights = [each.numbers.num_worlds for each in batch]
    names = batch[0].numbers.metrics
    means = {name: float(np.average([each.numbers.metrics[name] for each in batch], weights=weights)) for name in names}
    play_s = [each.numbers.play_s for each in batch]
    return means | {
        "world/num_broken": float(sum(each.numbers.num_broken for each in batch)),
        "time/play_s": float(np.mean(play_s)),
        "time/wait_for_generator_s": float(np.mean([each.numbers.generator_s for each in batch])),
        "time/hand_over_s": float(np.mean([each.hand_over_s for each in batch])),
    }


def num_gpus(device: str) -> int:
    """What the learner asks Ray for; an actor that asks for none sees none."""
    if device == "auto":
        return min(1, int(ray.cluster_resources().get("GPU", 0)))
    return int(device == "cuda")
