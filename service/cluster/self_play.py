"""Self-play on a Ray cluster: its workers are Ray actors, and a driver loses none of them.

| process | consumes | produces | waits for | bounded by |
|---|---|---|---|---|
| driver, ``RaySelfPlay`` | results of the others | calls, iterations, states | next result, ``POLL_S`` at most | - |
| rollout actors x N | weights, snapshot, opponents | a rollout, a goal summary | nothing | ``may_begin`` |
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
from typing import Any

import numpy as np
import ray
from ray.exceptions import ObjectLostError, RayError, RayTaskError

from service.actors.evaluation import evaluated_goals
from service.actors.rollout import MAX_POLICY_LAG, from_arrays
from service.base.errors import DivergedError
from service.base.types import Metrics
from service.base.user_code import CodeError
from service.cluster.actor_pool import ActorPool, ActorSlot
from service.cluster.iteration import OpenIteration, Round, may_begin, may_update
from service.cluster.ray_actors import GeneratorActor, LearnerActor, remote_actor
from service.cluster.ray_connection import ClusterOptions, last_line, num_gpus
from service.cluster.remote_worker import POLL_S, RemoteWorker, lost, take_copies
from service.cluster.watch import Clock, RayletWatch
from service.config.self_play import SelfPlayConfig
from service.methods.method import Health, Iteration, State, StateLostError, WorkersError
from service.methods.self_play import LocalSelfPlay, SelfPlay
from service.policies.parameters import Parameters, PolicyError
from service.registry.loading import Trained
from service.store.models import GoalGrid

_logger = logging.getLogger(__name__)

RESIZE_S = 5.0
"""Time between two looks at the size of the cluster."""
MAX_ATTEMPTS = 3
"""Learners or generators in a row that may die of the same iteration."""
MAX_FAILED_ROUNDS = 20
"""Rounds, or starts of actors, in a row that may fail, beside one of each actor: all of a lost node fail at once."""


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

    _pool: ActorPool

    def __init__(
        self,
        config: SelfPlayConfig,
        options: ClusterOptions,
        start_from: Trained | None = None,
        raylet: RayletWatch | None = None,
    ) -> None:
        super().__init__(config)
        self._options, self._start_from, self._raylet, self._clock = options, start_from, raylet, Clock()
        self._pending: list[Round] = []
        """Rounds that are played and not learned from."""
        self._carried: list[Any] = []
        """References to rollouts of an earlier process, to be learned from with the first ones."""
        self._current: OpenIteration | None = None
        self._copies: dict[Any, Any] = {}
        """Copies of what the next workers begin with, by reference; None until it is at this node."""
        self._evaluated: Metrics = {}
        self._grid: GoalGrid | None = None
        self._num_failed_rounds = self._num_counted = self._num_refused = 0
        self._last_error: str | None = None
        self._version = 0
        self._begun: State = {}
        """What the workers begin with; empty where it is nothing."""
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
        self._learner.start()
        self._generator.start()
        self._hand_out(has_new_opponents=True)
        self._version = _fetch(self._weights).version
        num = self._num_actors()
        game = self.config.game.model_copy(update={"num_worlds": -(-self.config.game.num_worlds // num)})
        config = self.config.model_copy(update={"game": game})
        first_incarnation = int(self._begun.get("next_incarnation", 0))
        self._begun = {}
        self._pool = ActorPool(config, options.actor_threads, first_incarnation, self._clock)
        self._to_close.append(self._pool.close)
        self._pool.resize(num)
        self._last_iteration = self._last_resize = time.monotonic()

    def step(self) -> Iteration | None:
        """Wait for a worker for a moment; the iteration that has ended meanwhile, if any."""
        self._start_iteration()
        self._start_rounds()
        with self.timing("wait"):
            ready = self._wait()
        take_copies(self._copies, ready)
        for slot in list(self._pool):
            self._take_from_actor(slot, ready)
        ended = self._take_iteration(ready)
        if self._raylet is None or not self._raylet.silent:  # else they may all wait for it
            self._clock.look()
            self._check_workers()
        return ended

    def evaluate(self) -> Metrics:
        """Ask actors for one kind of goals each; the success is in the metrics of a later iteration."""
        alive = [slot for slot in self._pool if slot.alive]
        kinds = evaluated_goals(self.config.world, self.config.success_distance_m)
        for index, kind in enumerate(kinds if alive else ()):
            alive[index % len(alive)].start_evaluation(self._weights, kind)
        return {}

    def parameters(self) -> Parameters:
        """The newest Bob, as he is evaluated and published."""
        parameters: Parameters = _fetch(self._weights).bob_ema
        return parameters

    def health(self) -> Health:
        """The state of all its workers."""
        lack: list[str] = []
        if waiting := sum(slot.waits for slot in self._pool):
            lack.append(f"{waiting} of {len(self._pool)} rollout actors wait for a free core")
        if late := ", ".join(slot.watch.name for slot in self._pool if slot.late):
            lack.append(f"{late}: late; updates go on without")
        actors = (*(slot.status() for slot in self._pool), self._learner.status(), self._generator.status())
        return Health(actors, self._num_counted, self._num_refused, tuple(lack), self._last_error)

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
            "next_incarnation": self._pool.next_incarnation,
            "rng": rng.bit_generator.state,
        }

    def load_state(self, state: State) -> None:
        """Let the workers, which have not started, begin with a state of any origin."""
        self._begun = state
        if "pending" in state:
            self._carried = [ray.put(from_arrays(state["pending"]))]

    def close(self) -> None:
        """End all workers."""
        for close in reversed(self._to_close):
            close()
        self._to_close.clear()

    def _worker(self, name: str, actor: Any) -> RemoteWorker:
        worker = RemoteWorker(name, actor, self.config, self._begun.get(name), self._clock, self.on_wait)
        self._to_close.append(worker.close)
        return worker

    def _wait(self) -> set[Any]:
        """Wait a moment for the next answer; references to all that are there."""
        workers = [worker.answer for worker in (self._learner, self._generator) if worker.answer is not None]
        copies = [reference for reference, value in self._copies.items() if value is None]
        awaited = [*self._pool.awaited, *workers, *copies]
        ray.wait(awaited, timeout=POLL_S)
        # All that is there, before any worker is called late or hung: after a pause that may be everything.
        ready, _ = ray.wait(awaited, num_returns=len(awaited), timeout=0)
        return set(ready)

    # --- rounds ----------------------------------------------------------------------------------------------------

    def _start_rounds(self) -> None:
        """Give every idle actor a round, as far as the policy lag allows it."""
        num, learned_from = self._pool.num_counted_on, self._current.batch if self._current is not None else []
        for slot in self._pool:
            num_on_the_way = len(self._pool.rounds) + len(self._pending) + len(learned_from)
            if slot.alive and slot.round is None and may_begin(num_on_the_way, num):
                slot.start_round(self._version, self._weights, self._snapshot, self._opponents, num)

    def _take_from_actor(self, slot: ActorSlot, ready: set[Any]) -> None:
        """Take what an actor has answered; one that has failed is replaced, and the round it played is lost."""
        try:
            if slot.starting in ready:
                slot.watch.location, slot.starting = ray.get(slot.starting), None
                if slot.num_replaced:
                    _logger.info("rollout actor %d is back, as its incarnation %d", slot.index, slot.watch.incarnation)
            for reference in ready.intersection(slot.evaluations):
                self._evaluated |= slot.finish_evaluation(reference)
            if slot.round is not None and slot.round.answer in ready:
                self._pending.append(slot.finish_round())
                self._num_failed_rounds = 0
        except (DivergedError, PolicyError):
            raise
        except Exception as error:  # whatever happened on another machine
            if isinstance(error, RayTaskError) and isinstance(error.cause, CodeError):
                raise error.cause from None  # every other actor has the same file of a user's
            reason = last_line(error)
            if lost(error):
                raise StateLostError(f"weights or goals went with the machine that kept them ({reason})") from None
            self._num_failed_rounds += 1
            if self._num_failed_rounds > MAX_FAILED_ROUNDS + len(self._pool):
                raise WorkersError(
                    f"{self._num_failed_rounds} rollout actors in a row failed, at last with: {reason}"
                ) from None
            self._replace(slot, reason)

    def _replace(self, slot: ActorSlot, reason: str) -> None:
        _logger.warning("rollout actor %d is gone (%s); another takes its place", slot.index, reason)
        self._last_error = f"{slot.watch.name}: {reason}"
        self._pool.replace(slot, reason)

    # --- iterations ------------------------------------------------------------------------------------------------

    def _start_iteration(self) -> None:
        """Give learner and generator what was played, if it is enough and makes no round being played too old."""
        num, played = self._pool.num_counted_on, [each.version for each in self._pool.rounds]
        if self._current is not None or len(self._pending) < num or not may_update(self._version, played):
            return
        self._refuse_old()
        if len(self._pending) < num:
            return
        batch, self._pending = self._pending, []  # all: one that were left over would only get older
        self._current = OpenIteration(batch)
        self._ask(self._generator, batch)
        self._ask(self._learner, batch)

    def _refuse_old(self) -> None:
        """Leave out rollouts that came too late to be learned from."""
        for each in [each for each in self._pending if self._version - each.version > MAX_POLICY_LAG]:
            _logger.info("rollout %s came %d versions late", each.summary.id, self._version - each.version)
            self._pending.remove(each)
            self._num_refused += 1

    def _ask(self, worker: RemoteWorker, batch: list[Round]) -> None:
        """Give a batch to the learner or the task generator."""
        if worker is self._learner:
            worker.ask("update_from", [*self._carried, *(each.rollout for each in batch)])
        else:
            num_env_steps = self.num_env_steps + sum(each.summary.num_env_steps for each in batch)
            weights = batch[0].weights  # the players of this iteration may become past opponents
            worker.ask("record_from", self.iteration, num_env_steps, weights, [each.goals for each in batch])

    def _take_iteration(self, ready: set[Any]) -> Iteration | None:
        """Take what learner and generator have answered; the iteration, once both have."""
        if (current := self._current) is None:
            return None
        if self._learner.answer in ready:
            current.updated = self._take_answer(self._learner, current)
        if self._generator.answer in ready:
            current.recorded = self._take_answer(self._generator, current)
        if self._learner.answer is not None or self._generator.answer is not None:
            return None
        self._current = None
        return self._finish_iteration(current) if current.batch else None  # else its rollouts were all lost

    def _take_answer(self, worker: RemoteWorker, iteration: OpenIteration) -> Any:
        """What it answers; None where it failed, and has been asked again what is left of the iteration."""
        try:
            return worker.take_answer()
        except RayError as error:
            if lost(error):
                reason = last_line(error)
                self._drop_lost(iteration.batch)
            elif isinstance(error, RayTaskError):  # the worker lives, and would fail again
                raise
            else:  # another goes on from the state before the iteration
                reason = worker.restart(error)
                self._last_error = f"{worker.name}: {reason}"
            iteration.num_attempts[worker.name] += 1
            if iteration.num_attempts[worker.name] >= MAX_ATTEMPTS:
                raise WorkersError(
                    f"{MAX_ATTEMPTS} times in a row the {worker.name} failed at the same rollouts, at last with: "
                    f"{reason}"
                ) from error
        if iteration.batch:
            self._ask(worker, iteration.batch)
        return None

    def _drop_lost(self, batch: list[Round]) -> None:
        """Forget rollouts that were lost with the node that held them."""
        for each in list(batch):
            try:
                ray.get([each.rollout, each.goals])
            except RayError as error:
                _logger.warning("rollout %s is lost (%s)", each.summary.id, last_line(error))
                batch.remove(each)

    def _finish_iteration(self, iteration: OpenIteration) -> Iteration:
        """Count an iteration whose version is out."""
        assert iteration.updated is not None
        assert iteration.recorded is not None
        learned, taken = iteration.updated
        recorded, self._grid, has_new_opponents = iteration.recorded
        now = time.monotonic()
        elapsed_s, self._last_iteration = now - self._last_iteration, now
        self._version = int(learned["learner/version"])
        self._hand_out(has_new_opponents=has_new_opponents)
        self._num_counted += sum(taken)
        self._num_refused += len(taken) - sum(taken)
        self._carried = []
        ended = self._finish(
            [each.summary for each in iteration.batch],
            recorded,
            learned,
            elapsed_s=elapsed_s,
            num_alive=sum(slot.alive for slot in self._pool),
            hand_over_s=float(np.mean([each.hand_over_s for each in iteration.batch])),
        )
        evaluated, self._evaluated = self._evaluated, {}
        return replace(ended, metrics=ended.metrics | evaluated)

    def _hand_out(self, *, has_new_opponents: bool) -> None:
        """Let the next rounds and workers have what learner and generator have made; copies of what is older go."""
        self._weights, self._learner.state = self._learner.made
        self._generator.state, self._snapshot, should_stop, opponents = self._generator.made
        self.converged = _fetch(should_stop)
        if has_new_opponents:
            self._opponents = opponents
        needed = [self._weights, self._snapshot, self._opponents, self._generator.state, self._learner.state]
        self._copies = {each: self._copies.get(each) for each in needed}

    # --- looking after workers -------------------------------------------------------------------------------------

    def _check_workers(self) -> None:
        """Go on without actors that are late, replace workers that hang, and follow the cluster's size."""
        for worker in (self._learner, self._generator):
            worker.end_if_hung()  # then its answer fails, and another takes its place
        for slot in list(self._pool):
            if slot.overdue and not slot.late:
                slot.late = True
                _logger.info("rollout actor %d is late; updates go on without it", slot.index)
            if (reason := slot.look()) is not None and slot.alive:
                self._replace(slot, reason)
            elif reason is not None:  # most likely it waits for a core, which is no failure
                _logger.info("rollout actor %d: %s; it is started anew", slot.index, reason)
                self._pool.replace(slot, None)
        now = time.monotonic()
        if now - self._last_resize >= RESIZE_S:
            self._last_resize = now
            self._pool.resize(self._num_actors())

    def _num_actors(self) -> int:
        if self._options.num_actors is not None:
            return self._options.num_actors
        cores = ray.cluster_resources().get("CPU", 0.0) - self._options.learner_cpus
        return max(1, int(cores // self._options.actor_threads))


def _fetch(state: Any) -> Any:
    try:
        return ray.get(state)
    except ObjectLostError as error:  # it went with its node, before it was copied to this one
        raise StateLostError(f"the newest state is lost ({last_line(error)})") from None
