"""One cell of the table, from nothing to its result: learn, evaluate on the way and at the end, save, continue.

Consumes primitives and settings; produces the files of ``directory``. Waits for nobody. It stops where ``stop`` says
so, between two iterations (an episode of every world), with everything saved; what a kill loses is what came after the
last checkpoint, and ``resume`` makes that again bit for bit.
"""

from __future__ import annotations

import functools
import logging
import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from service.actors.evaluation import Deterministic, Evaluation, evaluate, wilson_interval
from service.downstream.compose import parameters_digest
from service.downstream.directory import FORMAT_VERSION, TrainingDirectory, read_json, write_json
from service.downstream.methods import METHODS, Method, find_method
from service.downstream.settings import CellConfig
from service.envs.gym.registration import EPISODE_STEPS
from service.envs.gym.vector import TabletopVectorEnv
from service.envs.tasks import SUCCESS_DISTANCE_M, find_task
from service.errors import TandemError
from service.io.plain import plain
from service.registry.manifest import git_commit

if TYPE_CHECKING:
    from service.downstream.vec_env import WorldsVecEnv
    from service.primitives.loading import TrainedBob

CHECKPOINT_EVERY_S = 120.0
CURVE_SEED, FINAL_SEED = 1_000_000, 2_000_000
"""Added to a cell's seed: goals of evaluations are none that were learned on, and the same for every method."""
_NUM_FILMED = 6
_logger = logging.getLogger(__name__)
OnIteration = Callable[[dict[str, float]], None]
NewPlayer = Callable[[], Deterministic]
"""Makes who plays a batch of episodes, from their start."""


@dataclass(frozen=True, slots=True)
class Running:
    """How a cell runs; no part of what it is."""

    resume: bool = False
    num_threads: int = 0
    """Of physics and torch; 0: as many as there are cores."""
    film: bool = False
    """Whether to make a video; half a minute without a graphics card."""
    stop: Callable[[], bool] = lambda: False
    """Asked between iterations."""
    on_iteration: OnIteration = lambda metrics: None


def run_cell(cell: CellConfig, trained: TrainedBob, path: Path, running: Running) -> dict[str, Any] | None:
    """Run one cell in a directory.

    Returns:
        Its result as ``result.json`` has it; None where it was stopped before its end.

    Raises:
        TandemError: primitives that do not fit, or a directory that holds something else; nothing was overwritten.
    """
    method = find_method(cell.method)
    method.check(trained)
    identity = _identity(cell, trained)
    with TrainingDirectory(path) as directory:
        saved = directory.start(identity, resume=running.resume)
        if directory.result_file.exists():
            return read_json(directory.result_file)
        if method.player is not None:
            new_player = functools.partial(method.player, trained)
            score = _score(cell, trained, new_player, running)
            result = {**identity, **score, "env_steps": 0, "wall_s": 0.0, "curve": []}
            return _finish(result, cell, trained, new_player, directory, running)
        training = _Training(cell, method, trained, directory, running)
        try:
            learned = training.run(saved)
            if learned is None:
                return None
            if _identity(cell, trained) != identity:
                raise RuntimeError("the frozen primitives have changed while they were composed")
            return _finish({**identity, **learned}, cell, trained, training.new_player, directory, running)
        finally:
            training.env.close()


def check_cell(cell: CellConfig, trained: TrainedBob, path: Path) -> None:
    """Assert that ``run_cell`` could begin or continue in that directory; nothing is written.

    Raises:
        TandemError: it could not.
    """
    find_method(cell.method).check(trained)
    TrainingDirectory(path).check(_identity(cell, trained), resume=True)


def _identity(cell: CellConfig, trained: TrainedBob) -> dict[str, Any]:
    return {"cell": cell.model_dump(mode="json"), **describe(trained).of(cell.method)}


@dataclass(frozen=True, slots=True)
class Described:
    """What results are of, besides their cells: the primitives, and the world that they bring along."""

    primitives: dict[str, str]
    """Name, and SHA-256 of the parameters as ``digest``."""
    world: dict[str, Any]
    """Its settings, before a task replaces some."""

    def of(self, method: str) -> dict[str, Any]:
        """What a method's result says of them: no primitives where it takes none."""
        known = METHODS.get(method)
        without = known is not None and not known.takes_primitives
        return {"primitives": None if without else self.primitives, "world": self.world}


def describe(trained: TrainedBob) -> Described:
    """Which primitives and world these are."""
    name = trained.label if trained.manifest is None else trained.manifest.reference  # the same wherever it came from
    primitives = {"name": name, "digest": parameters_digest(trained.policy)}
    return Described(primitives, trained.config.world.model_dump(mode="json"))


class _Training:
    """A learner in its worlds."""

    def __init__(
        self, cell: CellConfig, method: Method, trained: TrainedBob, directory: TrainingDirectory, running: Running
    ) -> None:
        import torch

        from service.downstream.learner import make_learner

        torch.set_num_threads(running.num_threads or os.cpu_count() or 1)
        self.env = make_worlds(cell, method, trained, running.num_threads)
        self._learner = make_learner(cell, method, self.env)
        self._cell, self._method, self._trained = cell, method, trained
        self._directory, self._running = directory, running
        self._iteration, self._wall_s, self._saved_s = 0, 0.0, time.monotonic()
        self._curve: list[dict[str, float]] = []

    def run(self, saved: dict[str, Any] | None) -> dict[str, Any] | None:
        """Learn to the end; None where stopped before."""
        if saved is not None:
            self._restore(saved)
        while self._learner.num_timesteps < self._cell.num_env_steps:
            if self._running.stop():
                self._save()
                return None
            self._iterate()
            if time.monotonic() - self._saved_s >= CHECKPOINT_EVERY_S:
                self._save()
        self._save()
        if self._running.stop():
            return None
        self._learner.save(self._directory.path / "model.zip")
        score = _score(self._cell, self._trained, self.new_player, self._running)
        return {**score, "env_steps": self._learner.num_timesteps, "wall_s": self._wall_s, "curve": self._curve}

    def new_player(self) -> Deterministic:
        """What has been learned so far, ready for a batch of episodes."""
        from service.downstream.learner import LearnedPolicy

        return LearnedPolicy(self._learner, self._method, self._trained)

    def _iterate(self) -> None:
        """An episode of every world, with its updates; now and then an evaluation, which is not counted as time."""
        from service.downstream.learner import set_progress

        begun, before = time.perf_counter(), self._learner.num_timesteps
        set_progress(self._learner, self._method, before / self._cell.num_env_steps)
        num = min(EPISODE_STEPS * self.env.num_envs, self._cell.num_env_steps - before)
        self._learner.learn(num, reset_num_timesteps=self._iteration == 0, log_interval=None)  # type: ignore[arg-type]
        self._iteration += 1
        took = time.perf_counter() - begun
        self._wall_s += took
        steps = self._learner.num_timesteps
        metrics: dict[str, float] = {"iteration": self._iteration, "env_steps": steps, **self._episodes()}
        metrics |= {name: float(value) for name, value in self._learner.logger.name_to_value.items()}
        if self._iteration % self._cell.curve_every == 0 or steps >= self._cell.num_env_steps:
            metrics |= self._evaluate()
        metrics |= {"time/wall_s": self._wall_s, "time/env_steps_per_s": (steps - before) / took}
        self._directory.record(metrics)
        self._running.on_iteration(metrics)

    def _episodes(self) -> dict[str, float]:
        """Of the episodes that ended in this iteration, which were played with noise."""
        finished = np.array(self.env.finished, dtype=float).reshape(-1, 2)
        self.env.finished.clear()
        if not len(finished):
            return {}
        total, last = finished.T
        means = {"return": total.mean(), "success_last": last.mean(), "success_ever": (total > 0.0).mean()}
        return {f"rollout/{name}": float(value) for name, value in means.items()}

    def _evaluate(self) -> dict[str, float]:
        cell = self._cell
        found = play(cell, self._trained, self.new_player, cell.curve_episodes, cell.seed + CURVE_SEED, self._running)
        point = {"success_last": found.success_last, "success_ever": found.success_ever}
        self._curve.append({"env_steps": self._learner.num_timesteps, "wall_s": self._wall_s, **point})
        return {f"evaluation/{name}": value for name, value in point.items()}

    def _save(self) -> None:
        from service.downstream.learner import save_learner

        if not self._iteration:
            return
        counters = {"iteration": self._iteration, "env_steps": self._learner.num_timesteps, "wall_s": self._wall_s}
        learner = save_learner(self._learner, self.env)
        self._directory.write_checkpoint({**counters, "curve": self._curve, "learner": learner})
        self._saved_s = time.monotonic()

    def _restore(self, saved: dict[str, Any]) -> None:
        from service.downstream.learner import restore_learner

        restore_learner(self._learner, self.env, saved["learner"])
        self._iteration, self._wall_s, self._curve = saved["iteration"], saved["wall_s"], saved["curve"]


def make_worlds(cell: CellConfig, method: Method, trained: TrainedBob, num_threads: int) -> WorldsVecEnv:
    """The worlds that a method's learner acts in."""
    from service.downstream.vec_env import WorldsVecEnv

    worlds = TabletopVectorEnv(
        cell.sac.num_worlds,
        trained.config.world,
        task=cell.task,
        success_distance_m=SUCCESS_DISTANCE_M,
        max_episode_steps=EPISODE_STEPS,
        num_threads=num_threads,
    )
    return WorldsVecEnv(method.wrap(worlds, trained))


def play(
    cell: CellConfig, trained: TrainedBob, new_player: NewPlayer, num_episodes: int, seed: int, running: Running
) -> Evaluation:
    """Evaluate somebody on the cell's task."""
    task = find_task(cell.task)
    return evaluate(
        new_player(),
        task.world_from(trained.config.world),
        task.goals,
        num_episodes=num_episodes,
        num_steps=EPISODE_STEPS,
        success_distance_m=SUCCESS_DISTANCE_M,
        seed=seed,
        num_threads=running.num_threads,
    )


def _score(cell: CellConfig, trained: TrainedBob, new_player: NewPlayer, running: Running) -> dict[str, Any]:
    """The final evaluation, and where it was made."""
    found = play(cell, trained, new_player, cell.num_episodes, cell.seed + FINAL_SEED, running)
    low, high = wilson_interval(round(found.success_ever * found.num_episodes), found.num_episodes)
    evaluation = {**found.as_dict(), "success_ever_low": low, "success_ever_high": high}
    where = {"git_commit": git_commit(), "num_cores": os.cpu_count(), "num_threads": running.num_threads}
    return {"evaluation": evaluation, "made": where}


def _finish(
    result: dict[str, Any],
    cell: CellConfig,
    trained: TrainedBob,
    new_player: NewPlayer,
    directory: TrainingDirectory,
    running: Running,
) -> dict[str, Any]:
    """Pictures, then the result: where it is, nothing is left to do."""
    from service.downstream.pictures import draw_training

    makers: dict[str, Callable[[], Path]] = {}
    if directory.metrics_file.exists():
        makers["curves"] = lambda: draw_training(directory.path)
    if running.film:
        makers["video"] = lambda: _film(cell, trained, new_player(), directory.path / "episodes.mp4")
    for name, make in makers.items():
        try:
            make()
        except TandemError as error:
            _logger.warning("no %s: %s", name, error)
    result = plain({"format_version": FORMAT_VERSION, **result})
    write_json(directory.result_file, result)
    return result


def _film(cell: CellConfig, trained: TrainedBob, player: Deterministic, path: Path) -> Path:
    from service.media.video import film_episodes, write_episode_video

    task = find_task(cell.task)
    world = task.world_from(trained.config.world)
    filmed = film_episodes(
        player,
        world,
        task.goals,
        num_episodes=_NUM_FILMED,
        num_steps=EPISODE_STEPS,
        success_distance_m=SUCCESS_DISTANCE_M,
        seed=cell.seed + FINAL_SEED,
    )
    return write_episode_video(filmed, world, path)
