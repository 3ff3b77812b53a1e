"""One trial, from nothing to its result: learn, evaluate on the way and at the end, save, continue.

Consumes primitives and settings; produces the files of ``directory``. Waits for nobody. It stops where ``stop`` says
so, between two iterations (an episode of every world), with everything saved; what a kill loses is what came after the
last checkpoint, and ``resume`` makes that again bit for bit.
"""

from __future__ import annotations

import contextlib
import functools
import logging
import os
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from service.actors.evaluation import DeterministicPolicy, wilson_interval
from service.downstream.curves import draw_training
from service.downstream.directory import TrainingDirectory
from service.downstream.files import FORMAT_VERSION, TRIAL, read_result, write_json
from service.downstream.learner import make_loop, set_progress, spread_seed
from service.downstream.methods import Method, find_method, provenance
from service.downstream.playing import CURVE_SEED, FINAL_SEED, evaluate_on, record_on
from service.downstream.settings import TrialConfig
from service.downstream.worlds import TaskWorlds
from service.envs.gym.vector import TabletopVectorEnv
from service.envs.tasks import EPISODE_STEPS, SUCCESS_DISTANCE_M, find_task
from service.errors import TandemError
from service.io.checkpoints import Checkpoint
from service.io.git import git_commit
from service.io.jsonl import plain
from service.primitives.learned import save_policy
from service.primitives.loading import Trained
from service.progress import Task, doing

CHECKPOINT_EVERY_S = 120.0
_NUM_RECORDED = 6
"""Episodes in a video."""
_logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Callbacks:
    """Functions of the caller: to be told how a trial or a table goes on, and to say when to stop."""

    stop: Callable[[], bool] = lambda: False
    """Asked between iterations, and between trials."""
    on_iteration: Callable[[dict[str, float]], None] = lambda metrics: None
    say: Callable[[str], None] = lambda text: None


@dataclass(frozen=True, slots=True)
class RunOptions:
    """Options of running a trial; its result does not depend on them, but for the last bits (threads)."""

    resume: bool = False
    num_threads: int = 0
    """Threads of physics and torch; 0: torch has one, and worlds are stepped by as many as there are cores. Several
    threads of torch wait for each other by turning round and round: beside other work they are slower than one."""
    video: bool = False
    """Whether to make a video; half a minute without a graphics card."""
    callbacks: Callbacks = Callbacks()


def run_trial(trial: TrialConfig, trained: Trained, path: Path, options: RunOptions) -> dict[str, Any] | None:
    """Run one trial in a directory.

    Returns:
        Its result as ``result.json`` has it; None where it was stopped before its end.

    Raises:
        TandemError: primitives that do not fit, or a directory that holds something else; nothing was overwritten.
    """
    method = find_method(trial.method)
    method.check(trained)
    identity = _identity(trial, trained)
    with TrainingDirectory(path) as directory, contextlib.ExitStack() as stack:
        saved = directory.start(identity, resume=options.resume)
        if directory.result_file.exists():
            return read_result(directory.result_file)
        learned: dict[str, Any] | None = {"env_steps": 0, "wall_s": 0.0, "curve": []}
        if method.player is None:
            training = _Training(trial, method, trained, directory, options)
            stack.callback(training.worlds.close)
            learned, new_player = training.run(saved), training.new_player
        else:
            new_player = functools.partial(method.player, trained)
        if learned is None:
            return None
        world, seed = trained.config.world, trial.seed + FINAL_SEED
        found = evaluate_on(trial.task, world, new_player(), trial.num_episodes, seed, options.num_threads)
        low, high = wilson_interval(round(found.success_ever * found.num_episodes), found.num_episodes)
        evaluation = {**found.as_dict(), "success_ever_low": low, "success_ever_high": high}
        if _identity(trial, trained) != identity:
            raise RuntimeError("what is frozen has changed while it was acted with")
        made = {"git_commit": git_commit(), "num_cores": os.cpu_count(), "num_threads": options.num_threads}
        if method.player is None:
            with _only_warn("curves"):
                draw_training(path)
        if options.video:
            with _only_warn("video"):
                _record_video(trial, trained, new_player(), path / "episodes.mp4")
        result: dict[str, Any] = plain(
            {"format_version": FORMAT_VERSION, **identity, "evaluation": evaluation, "made": made, **learned}
        )
        write_json(directory.result_file, result)  # last: where it is, nothing is left to do
        return result


def check_trial(trial: TrialConfig, trained: Trained, path: Path) -> None:
    """Assert that ``run_trial`` could begin or continue in that directory; nothing is written.

    Raises:
        TandemError: it could not.
    """
    find_method(trial.method).check(trained)
    TrainingDirectory(path).check(_identity(trial, trained), resume=True)


def _identity(trial: TrialConfig, trained: Trained) -> dict[str, Any]:
    return {TRIAL: trial.model_dump(mode="json"), **provenance(trained, trial.method)}


class _Training:
    """A learner in its worlds."""

    def __init__(
        self, trial: TrialConfig, method: Method, trained: Trained, directory: TrainingDirectory, options: RunOptions
    ) -> None:
        torch.set_num_threads(options.num_threads or 1)
        self.worlds = make_worlds(trial, method, trained, options.num_threads)
        self._loop = make_loop(trial, method, trained, self.worlds)
        self._trial, self._method, self._trained = trial, method, trained
        self._directory, self._num_threads, self._callbacks = directory, options.num_threads, options.callbacks
        self._iteration, self._wall_s, self._saved_s = 0, 0.0, time.monotonic()
        self._curve: list[dict[str, float]] = []
        self._told: dict[str, str] = {}
        """How good the learner was last, shown beside the progress."""

    def new_player(self) -> DeterministicPolicy:
        """Make the policy learned so far, ready for a batch of episodes."""
        parameters = self._loop.learner.averaged_parameters()
        return self._method.learned(parameters, self._trained, self.worlds.steps_per_action)

    def run(self, saved: Checkpoint | None) -> dict[str, Any] | None:
        """Learn to the end; None where stopped before."""
        if saved is not None:
            self._loop.load_state(saved.arrays, saved.meta["loop"])
            self._iteration, self._wall_s, self._curve = saved.step, saved.meta["wall_s"], saved.meta["curve"]
        done, total = self._loop.num_env_steps, self._trial.num_env_steps
        with doing(f"learning {self._trial.name}", total, "env steps", done) as task:
            while self._loop.num_env_steps < total:
                if self._callbacks.stop():
                    self._save()
                    return None
                self._iterate(task)
                if time.monotonic() - self._saved_s >= CHECKPOINT_EVERY_S:
                    self._save()
        self._save()
        if self._callbacks.stop():
            return None
        parameters = self._loop.learner.averaged_parameters()
        held = self.worlds.steps_per_action
        method = self._trial.method
        acts_with = provenance(self._trained, method)["primitives"]
        save_policy(self._directory.policy_file, parameters, method, acts_with, held)
        return {"env_steps": self._loop.num_env_steps, "wall_s": self._wall_s, "curve": self._curve}

    def _iterate(self, task: Task) -> None:
        """Play an episode in every world, with its updates; now and then evaluate, which is not counted as time."""
        begun, before = time.perf_counter(), self._loop.num_env_steps
        set_progress(self._loop, self._method, before / self._trial.num_env_steps)
        num = min(EPISODE_STEPS * self.worlds.num_worlds, self._trial.num_env_steps - before)
        learned = self._loop.play(num, task.advance)
        self._iteration += 1
        took = time.perf_counter() - begun
        self._wall_s += took
        steps = self._loop.num_env_steps
        metrics: dict[str, float] = {"iteration": self._iteration, "env_steps": steps, **self._episodes()}
        metrics |= {f"learner/{name}": value for name, value in learned.items()}
        metrics["learner/num_updates"] = self._loop.num_updates
        if self._iteration % self._trial.curve_every == 0 or steps >= self._trial.num_env_steps:
            metrics |= self._evaluate()
        metrics |= {"time/wall_s": self._wall_s, "time/env_steps_per_s": (steps - before) / took}
        self._directory.record(metrics)
        for key, name in (("rollout/success_last", "success with noise"), ("evaluation/success_last", "without")):
            if key in metrics:  # the last iteration may be too short for an episode
                self._told[name] = f"{name} {metrics[key]:.0%}"
        task.note = ", ".join(self._told.values())
        self._callbacks.on_iteration(metrics)

    def _episodes(self) -> dict[str, float]:
        """Means over the episodes that ended in this iteration, which were played with noise."""
        finished = np.array(self.worlds.finished, dtype=float).reshape(-1, 2)
        self.worlds.finished.clear()
        if not len(finished):
            return {}
        total, last = finished.T
        means = {"return": total.mean(), "success_last": last.mean(), "success_ever": (total > 0.0).mean()}
        return {f"rollout/{name}": float(value) for name, value in means.items()}

    def _evaluate(self) -> dict[str, float]:
        trial, seed = self._trial, self._trial.seed + CURVE_SEED
        world = self._trained.config.world
        found = evaluate_on(trial.task, world, self.new_player(), trial.curve_episodes, seed, self._num_threads)
        point = {"success_last": found.success_last, "success_ever": found.success_ever}
        self._curve.append({"env_steps": self._loop.num_env_steps, "wall_s": self._wall_s, **point})
        return {f"evaluation/{name}": value for name, value in point.items()}

    def _save(self) -> None:
        if not self._iteration:
            return
        arrays, values = self._loop.state()
        meta = {"env_steps": self._loop.num_env_steps, "wall_s": self._wall_s, "curve": self._curve, "loop": values}
        self._directory.save(self._iteration, arrays, meta)
        self._saved_s = time.monotonic()


def make_worlds(trial: TrialConfig, method: Method, trained: Trained, num_threads: int) -> TaskWorlds:
    """Make the worlds that a method's learner acts in."""
    worlds = TabletopVectorEnv(
        trial.sac.num_worlds,
        trained.config.world,
        task=trial.task,
        success_distance_m=SUCCESS_DISTANCE_M - trial.reward_margin_m,
        max_episode_steps=EPISODE_STEPS,
        num_threads=num_threads,
    )
    return method.enter(worlds, spread_seed(trial.seed, 3), trained, trial.skill_steps)


@contextlib.contextmanager
def _only_warn(name: str) -> Iterator[None]:
    """Log a warning where a picture or video cannot be made; the result does not need it."""
    try:
        yield
    except TandemError as error:
        _logger.warning("no %s: %s", name, error)


def _record_video(trial: TrialConfig, trained: Trained, player: DeterministicPolicy, path: Path) -> Path:
    from service.media.video import write_episode_video

    world = find_task(trial.task).world_from(trained.config.world)
    episodes = record_on(trial.task, trained.config.world, player, _NUM_RECORDED, trial.seed + FINAL_SEED)
    return write_episode_video(episodes, world, path)
