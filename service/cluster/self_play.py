"""Self-play on a Ray cluster: its workers are Ray actors, and a driver loses none of them.

| process | consumes | produces | waits for | bounded by |
|---|---|---|---|---|
| driver, ``RaySelfPlay`` | results of the others | calls, iterations, states | next result, ``POLL_S`` at most | - |
| rollout actors x N | weights, snapshot, opponents | a rollout, a goal summary | nothing | ``RolloutSlots`` |
| learner | rollouts of one iteration | weights, its state, metrics | nothing | one update at a time |
| task generator | goal summaries of one iteration | snapshot, opponents, its state | nothing | one record at a time |

The weights of an iteration and the task generator's snapshot come out together, and a round is given the newest of
both. No worker calls another: one that dies or freezes holds back iterations, and no round.

The driver hands on references, not data. Learner and generator hand back their whole state with every iteration, of
which the driver's node keeps a copy; so when one dies, alone or with its node, another goes on from there with the
rollouts in hand: what an actor handed over is neither lost, but with its own node, nor counted twice.

A worker hangs when it makes no progress (``watch``): it is ended, and then it is like one that died. Before that, an
actor that is late no longer holds back updates. Only time in which the driver looks after its workers counts.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import ray
from ray.exceptions import ObjectLostError, RayError

from service.actors.evaluation import EVALUATED_GOALS
from service.actors.rollout import from_arrays
from service.base.errors import DivergedError
from service.base.types import Arrays, Metrics
from service.cluster.actor_pool import ActorPool, ActorSlot
from service.cluster.copies import Copies
from service.cluster.iteration import OpenIteration, PendingRollout
from service.cluster.ray_actors import GeneratorActor, LearnerActor, remote_actor
from service.cluster.ray_connection import ClusterOptions
from service.cluster.raylet import RayletWatch
from service.cluster.remote_worker import POLL_S, START_S, RemoteWorker, lost, one_line, pause, wait_for
from service.cluster.slots import RolloutSlots
from service.cluster.watch import Clock, Watch
from service.config.self_play import SelfPlayConfig
from service.learner.weights import MAX_POLICY_LAG
from service.methods.method import Health, Iteration, State, StateLostError, WorkersError
from service.methods.self_play import IterationResult, LocalSelfPlay, SelfPlay
from service.methods.workers import RoundSummary
from service.policies.parameters import Parameters, PolicyError
from service.registry.loading import Trained
from service.store.models import GoalGrid

_logger = logging.getLogger(__name__)

RESIZE_S = 5.0
"""Time between two looks at the size of the cluster."""
MAX_ATTEMPTS = 3
"""Learners or generators in a row that may die of the same iteration."""
RETRY_S = 1.0
"""Pause before the second of them is asked; it doubles."""
MAX_FAILED_ROUNDS = 20
"""Rounds, or starts of actors, in a row that may fail."""


class RaySelfPlay(SelfPlay):
    """Self-play on the Ray cluster that this process is connected to.

    ``step`` consumes what actors, learner and generator have finished, and starts what can start. It waits for the
    next of them to finish, at most ``POLL_S``.

    Args:
        config: the run. Its ``game.num_worlds`` are shared out among the actors there are at the start.
        options: of the cluster.
        start_from: what a new run begins from; None: from nothing.
        raylet: watch over that of this machine; None where there is none.
    """

    def __init__(
        self,
        config: SelfPlayConfig,
        options: ClusterOptions,
        start_from: Trained | None = None,
        raylet: RayletWatch | None = None,
    ) -> None:
        super().__init__(config)
        self._options, self._start_from, self._raylet, self._clock = options, start_from, raylet, Clock()
        self._waiting: dict[Any, Callable[[Any], None]] = {}
        self._copies = Copies()
        self._slots = RolloutSlots()
        self._pending: list[PendingRollout] = []
        self._carried: list[Any] = []
        """References to rollouts of an earlier process, to be learned from with the first ones."""
        self._current: OpenIteration | None = None
        self._ended: Iteration | None = None
        self._evaluated: Metrics = {}
        self._grid: GoalGrid | None = None
        self._num_failed_rounds = self._num_counted = self._num_refused = 0
        self._last_error: str | None = None
        self._last_iteration = self._last_resize = time.monotonic()
        self._first_incarnation = 0
        self._next_incarnation = 1
        self._states: dict[str, Arrays | None] = {"learner": None, "generator": None}
        self._to_close: list[Callable[[], None]] = []

    def start(self, state: State | None = None) -> None:
        """Start the workers, from a state or what the run begins from.

        Raises:
            WorkersError: learner or generator do not start.
        """
        if state is None and self._start_from is not None:
            on_cpu = self.config.learner.model_copy(update={"device": "cpu"})
            begun = LocalSelfPlay(self.config.model_copy(update={"learner": on_cpu}), self._start_from)
            state = begun.state()
            begun.close()
        if state is not None:
            self.load_state(state)
        options, device = self._options, self.config.learner.device
        learner = remote_actor(LearnerActor, num_cpus=options.learner_cpus, num_gpus=num_gpus(device))
        self._learner = self._worker("learner", learner)
        self._generator = self._worker("generator", remote_actor(GeneratorActor, num_cpus=0))
        self._states.clear()
        self._learner.start()
        self._generator.start()
        self._weights, self._learner.state = self._begin(self._learner, 2)
        self._generator.state, self._snapshot, self._opponents = self._begin(self._generator, 3)
        self._version: int = ray.get(self._weights).version
        self._keep_copies()
        self._pool = self._start_actors(self._first_incarnation)
        self._to_close.append(self._pool.close)
        self._last_iteration = time.monotonic()

    def step(self) -> Iteration | None:
        """Wait for a worker for a moment; the iteration that has ended meanwhile, if any."""
        self._ended = None
        self._start_iteration()
        self._start_rounds()
        with self.timing("wait"):
            ray.wait(list(self._waiting), timeout=POLL_S)
            # All that is there, before anybody is called late or hung: after a pause that may be everything.
            ready, _ = ray.wait(list(self._waiting), num_returns=len(self._waiting), timeout=0)
        for reference in ready:
            self._waiting.pop(reference)(reference)
        if self._raylet is None or not self._raylet.silent:  # else they may all wait for it
            self._clock.look()
            self._check_workers()
        return self._ended

    def evaluate(self) -> Metrics:
        """Ask actors for one kind of goals each; the success is in the metrics of a later iteration."""
        alive = [slot for slot in self._pool if slot.alive]
        for index, kind in enumerate(EVALUATED_GOALS if alive else ()):
            slot = alive[index % len(alive)]
            slot.start_evaluation()
            self._waiting[slot.handle.evaluate.remote(self._weights, [kind])] = partial(self._on_evaluation, slot)
        return {}

    def parameters(self) -> Parameters:
        """The newest Bob, as he is evaluated and published."""
        parameters: Parameters = _fetch(self._weights).bob_ema
        return parameters

    def health(self) -> Health:
        """The state of all its workers."""
        waiting = self._pool.num_waiting
        lack: tuple[str, ...] = (
            (f"{waiting} of {len(self._pool)} rollout actors wait for a free core",) if waiting else ()
        )
        if late := ", ".join(f"rollout-{slot.index}" for slot in self._pool.late):
            lack += (f"{late}: late; updates go on without",)
        actors = (*(slot.status() for slot in self._pool), self._learner.status(), self._generator.status())
        return Health(actors, self._num_counted, self._num_refused, lack, self._last_error)

    def grid(self) -> GoalGrid | None:
        """The task generator's goal grid after the last iteration; None before the first."""
        return self._grid

    def state(self) -> State:
        """Learner and generator after the last iteration; rounds being played and their actors are no part of it."""
        weights, learner, generator = _fetch([self._weights, self._learner.state, self._generator.state])
        rng = np.random.default_rng([self.config.seed, self.iteration])  # what a process of its own goes on with
        return {
            "learner": learner,
            "generator": generator,
            "alice": weights.alice,  # for readers without torch
            "bob": weights.bob_ema,
            "next_incarnation": self._next_incarnation,
            "rng": rng.bit_generator.state,
        }

    def load_state(self, state: State) -> None:
        """Let the workers, which have not started, begin with a state of any origin."""
        self._states = {"learner": state["learner"], "generator": state["generator"]}
        if "pending" in state:
            self._carried = [ray.put(from_arrays(state["pending"]))]
        self._first_incarnation = int(state["next_incarnation"])
        self._next_incarnation = self._first_incarnation + 1

    def close(self) -> None:
        """End all workers."""
        for close in reversed(self._to_close):
            close()
        self._to_close.clear()

    def _worker(self, name: str, actor: Any) -> RemoteWorker:
        worker = RemoteWorker(name, actor, self.config, self._states[name], self._clock, self._wait)
        self._to_close.append(worker.close)
        return worker

    def _wait(self) -> None:
        self.on_wait()

    # --- rounds ----------------------------------------------------------------------------------------------------

    def _start_rounds(self) -> None:
        """Give every idle actor a round, as far as there are rollout slots."""
        for slot in self._pool:
            if slot.idle and self._slots.may_begin(self._pool.num_counted_on):
                self._start_round(slot)

    def _start_round(self, slot: ActorSlot) -> None:
        ticket = self._slots.begin(self._version)
        play = slot.handle.play_round.options(num_returns=3)
        num_rounds = self._pool.num_counted_on
        rollout, goals, summary = play.remote(self._weights, self._snapshot, self._opponents, num_rounds)
        slot.start_round(ticket)
        pending = partial(PendingRollout, ticket, self._version, rollout, goals, self._weights)
        self._waiting[summary] = partial(self._on_round, slot, ticket, pending)

    def _on_round(self, slot: ActorSlot, ticket: int, pending: Callable[..., PendingRollout], reference: Any) -> None:
        if not self._pool.holds(slot):
            return  # it was replaced meanwhile, and its ticket given back
        try:
            summary: RoundSummary = ray.get(reference)
        except Exception as error:  # whatever happened on another machine
            self._on_failed_round(slot, ticket, error)
            return
        self._num_failed_rounds = 0
        slot.finish_round(summary)
        self._slots.finish(ticket)
        self._pending.append(pending(summary, time.monotonic() - slot.round_started - summary.play_s))

    def _on_failed_round(self, slot: ActorSlot, ticket: int, error: Exception) -> None:
        """Replace the actor, unless the run as a whole cannot go on."""
        if isinstance(error, (DivergedError, PolicyError)):
            raise error
        if lost(error):
            raise StateLostError(f"weights or goals went with the machine that kept them ({one_line(error)})") from None
        self._slots.lose(ticket)
        self._on_failed_actor(slot, one_line(error))

    def _on_failed_actor(self, slot: ActorSlot, reason: str) -> None:
        self._num_failed_rounds += 1
        if self._num_failed_rounds > MAX_FAILED_ROUNDS:
            raise WorkersError(f"{MAX_FAILED_ROUNDS + 1} rollout actors in a row failed, at last with: {reason}")
        self._replace(slot, reason)

    def _replace(self, slot: ActorSlot, reason: str) -> None:
        _logger.warning("rollout actor %d is gone (%s); another takes its place", slot.index, reason)
        self._last_error = f"rollout-{slot.index}: {reason}"
        self._await_start(self._pool.replace(slot, reason))

    def _await_start(self, slot: ActorSlot) -> None:
        self._next_incarnation = max(self._next_incarnation, slot.incarnation + 1)
        self._waiting[slot.handle.ping.remote()] = partial(self._on_start, slot)

    def _on_start(self, slot: ActorSlot, reference: Any) -> None:
        if not self._pool.holds(slot):
            return
        try:
            slot.location = ray.get(reference)
            if slot.incarnation > 0:
                _logger.info("rollout actor %d is back, as its incarnation %d", slot.index, slot.incarnation)
        except RayError as error:
            self._on_failed_actor(slot, one_line(error))

    # --- iterations ------------------------------------------------------------------------------------------------

    def _start_iteration(self) -> None:
        """Give learner and generator what was played, if it is enough and makes no round being played too old."""
        num = self._pool.num_counted_on
        if self._current is not None or len(self._pending) < num or not self._slots.may_update(self._version):
            return
        self._refuse_old()
        if len(self._pending) < num:
            return
        batch, self._pending = self._pending, []  # all: one that were left over would only get older
        self._current = OpenIteration(batch)
        self._ask_generator(self._current)
        self._ask_learner(self._current)

    def _refuse_old(self) -> None:
        """Leave out rollouts that came too late to be learned from."""
        for each in [each for each in self._pending if self._version - each.version > MAX_POLICY_LAG]:
            _logger.info("rollout %s came %d versions late", each.summary.id, self._version - each.version)
            self._pending.remove(each)
            self._slots.lose(each.ticket)
            self._num_refused += 1

    def _ask_learner(self, iteration: OpenIteration) -> None:
        rollouts = [*self._carried, *(each.rollout for each in iteration.batch)]
        updated, *others = self._learner.handle.update_from.options(num_returns=3).remote(rollouts)
        iteration.weights, iteration.learner_state = others
        self._learner.watch.begin()
        self._waiting[updated] = partial(self._on_learned, iteration, self._learner.watch)

    def _ask_generator(self, iteration: OpenIteration) -> None:
        num_env_steps = self.num_env_steps + iteration.num_env_steps
        goals = [each.goals for each in iteration.batch]
        record = self._generator.handle.record_from.options(num_returns=4)
        weights = iteration.batch[0].weights  # the players of this iteration may become past opponents
        recorded, *others = record.remote(self.iteration, num_env_steps, weights, goals)
        iteration.generator_state, iteration.snapshot, iteration.opponents = others
        self._generator.watch.begin()
        self._waiting[recorded] = partial(self._on_recorded, iteration, self._generator.watch)

    def _on_learned(self, iteration: OpenIteration, watch: Watch, reference: Any) -> None:
        watch.end()
        if iteration is not self._current:
            return  # its rollouts were all lost
        try:
            iteration.updated = ray.get(reference)
        except RayError as error:
            self._on_failed_answer(iteration, self._learner, error)
            return
        self._finish_if_done(iteration)

    def _on_recorded(self, iteration: OpenIteration, watch: Watch, reference: Any) -> None:
        watch.end()
        if iteration is not self._current:
            return  # its rollouts were all lost
        try:
            iteration.recorded, iteration.grid = ray.get(reference)
        except RayError as error:
            self._on_failed_answer(iteration, self._generator, error)
            return
        self._finish_if_done(iteration)

    def _on_failed_answer(self, iteration: OpenIteration, worker: RemoteWorker, error: Exception) -> None:
        """Start another learner or generator from the state before the iteration, and ask it what is left of that."""
        is_lost = lost(error)
        reason = one_line(error) if is_lost else worker.explain(error)
        if is_lost:
            self._drop_lost(iteration)
        elif isinstance(error, (DivergedError, PolicyError)) or worker.alive:
            raise error
        else:
            pause(RETRY_S * 2 ** (attempt - 1) if (attempt := iteration.num_attempts[worker.name]) else 0.0, self._wait)
            self._last_error = f"{worker.name}: {reason}"
            worker.restart(reason)
        iteration.num_attempts[worker.name] += 1
        if iteration.num_attempts[worker.name] >= MAX_ATTEMPTS:
            raise WorkersError(
                f"{MAX_ATTEMPTS} times in a row the {worker.name} failed at the same rollouts, at last with: {reason}"
            ) from error
        if not iteration.batch:
            self._current = None
        elif worker is self._learner:
            self._ask_learner(iteration)
        else:
            self._ask_generator(iteration)

    def _drop_lost(self, iteration: OpenIteration) -> None:
        """Forget rollouts that were lost with the node that held them."""
        for each in list(iteration.batch):
            try:
                ray.get([each.rollout, each.goals])
            except RayError as error:
                _logger.warning("rollout %s is lost (%s)", each.summary.id, one_line(error))
                iteration.batch.remove(each)
                self._slots.lose(each.ticket)

    def _finish_if_done(self, iteration: OpenIteration) -> None:
        """Count and record an iteration once its version is out, and give its rollout slots back."""
        updated, recorded = iteration.updated, iteration.recorded
        if updated is None or recorded is None:
            return
        now = time.monotonic()
        elapsed_s, self._last_iteration = now - self._last_iteration, now
        self._weights, self._version = iteration.weights, updated.version
        self._snapshot = iteration.snapshot
        if recorded.new_opponents:
            self._opponents = iteration.opponents
        self._learner.state, self._generator.state = iteration.learner_state, iteration.generator_state
        self._carried = []
        self._keep_copies()
        self._slots.publish([each.ticket for each in iteration.batch])
        self._current, self._grid = None, iteration.grid
        self._num_counted += len(updated.counted)
        self._num_refused += len(updated.refused)
        result = IterationResult(
            [each.summary for each in iteration.batch],
            recorded,
            updated,
            num_actors_alive=self._pool.num_alive,
            elapsed_s=elapsed_s,
            hand_over_s=float(np.mean([each.hand_over_s for each in iteration.batch])),
        )
        evaluated, self._evaluated = self._evaluated, {}
        ended = self._finish(result)
        self._ended = replace(ended, metrics=ended.metrics | evaluated)

    def _on_evaluation(self, slot: ActorSlot, reference: Any) -> None:
        slot.finish_evaluation()
        try:
            self._evaluated |= ray.get(reference)
        except RayError as error:
            _logger.warning("without this evaluation: %s", one_line(error))

    def _keep_copies(self) -> None:
        """Let the driver's node have what the next workers would begin with."""
        needed = [self._weights, self._snapshot, self._opponents, self._generator.state, self._learner.state]
        self._waiting |= self._copies.keep(needed)

    # --- looking after workers -------------------------------------------------------------------------------------

    def _check_workers(self) -> None:
        """Go on without actors that are late, replace workers that hang, and follow the cluster's size."""
        for worker in (self._learner, self._generator):
            worker.end_if_hung()  # then its answer fails, and another takes its place
        for slot in self._pool.become_late():
            assert slot.ticket is not None
            self._slots.release(slot.ticket)
            _logger.info("rollout actor %d is late; updates go on without it", slot.index)
        for slot, reason in self._pool.hung():
            if slot.ticket is not None:
                self._slots.lose(slot.ticket)
            self._replace(slot, reason)
        now = time.monotonic()
        if now - self._last_resize >= RESIZE_S:
            self._last_resize = now
            for slot in self._pool.resize(self._num_actors()):
                self._await_start(slot)

    def _num_actors(self) -> int:
        if self._options.num_actors is not None:
            return self._options.num_actors
        cores = ray.cluster_resources().get("CPU", 0.0) - self._options.learner_cpus
        return max(1, int(cores // self._options.actor_threads))

    def _start_actors(self, first_incarnation: int) -> ActorPool:
        num = self._num_actors()
        game = self.config.game.model_copy(update={"num_worlds": -(-self.config.game.num_worlds // num)})
        config = self.config.model_copy(update={"game": game})
        pool = ActorPool(config, self._options.actor_threads, first_incarnation, self._clock)
        for slot in pool.resize(num):
            self._await_start(slot)
        return pool

    def _begin(self, worker: RemoteWorker, num: int) -> list[Any]:
        """The references, so many, to what a worker has before the first iteration; it is there when this returns."""
        for _ in range(MAX_ATTEMPTS):
            try:
                begun: list[Any] = worker.handle.begin.options(num_returns=num).remote()
                wait_for(begun, START_S, self._wait)
                return begun
            except RayError as error:
                worker.restart(worker.explain(error))
        raise WorkersError(f"the {worker.name} fails as it begins, {MAX_ATTEMPTS} times in a row")


def num_gpus(device: str) -> int:
    """GPUs that the learner asks Ray for; an actor that asks for none sees none."""
    if device == "auto":
        return int(ray.cluster_resources().get("GPU", 0.0) >= 1.0)
    return int(device == "cuda")


def _fetch(state: Any) -> Any:
    try:
        return ray.get(state)
    except ObjectLostError as error:  # it went with its node, before it was copied to this one
        raise StateLostError(f"the newest state is lost ({one_line(error)})") from None
