"""The runner of privileged distillation: one process, records and checkpoints as of self-play."""

from __future__ import annotations

import logging
import time

import numpy as np
import torch

from service.actors.distillation import DistillationWorlds
from service.actors.evaluation import EVALUATED_GOALS, EVALUATION_SEED, success_metrics
from service.config import Config
from service.envs.observations import Layouts, layouts
from service.errors import TandemError
from service.generator.bins import GoalCells
from service.io.run_directory import RunDirectory
from service.learner import transfer
from service.learner.distillation import Distiller
from service.policies import networks
from service.policies.numpy_policy import NumpyMCPPolicy, numpy_bob
from service.policies.parameters import Parameters
from service.runtime.runner import Health, OnBeat, Runner
from service.runtime.starting import Start
from service.store.models import GoalGrid
from service.types import Metrics, StateArray
from service.world_config import ObservedConfig

NUM_RECORDED_GOALS = 32
"""Of each iteration, for the run directory."""
_logger = logging.getLogger(__name__)


class DistillationRun(Runner):
    """A run in this process in which Bob learns from a teacher; an iteration is an episode of every world.

    Args:
        config: the run, with ``distillation``.
        directory: where it keeps everything; see ``RunDirectory``.
        resume: continue from the newest checkpoint instead of starting anew.
        start: the teacher, from whom the student begins as well; a run that is resumed has him in its checkpoint.

    Raises:
        TandemError: no teacher, or one without primitives; see ``RunDirectory.claim``.
        CheckpointError: ``resume`` without a usable checkpoint.
    """

    def __init__(
        self, config: Config, directory: RunDirectory, *, resume: bool = False, start: Start | None = None
    ) -> None:
        assert config.distillation is not None
        if start is None and not resume:
            raise TandemError("distillation learns from a trained Bob: name him, --from NAME@ALIAS")
        directory.claim(resume=resume)
        super().__init__(config, directory)
        with torch.random.fork_rng(devices=[]):
            torch.default_generator.manual_seed(config.seed)
            self._distiller = Distiller(
                networks.MCPPolicy(config.policy.bob, layouts=layouts(config.world)), config.distillation
            )
        self._rng = np.random.default_rng(config.seed)
        self._cells = GoalCells(config.world, config.generator.cell_size_m)
        self._tries, self._solved = (np.zeros(len(self._cells), dtype=np.int64) for _ in range(2))
        self._num_broken = 0
        if start is not None and not resume:
            self._teacher_parameters, self._observed = dict(start.networks["bob/policy"]), start.world.observed
            self._begin_from(start)
        else:
            self._load()
        teacher = self._teacher()
        taught = config.world.model_copy(update={"observed": self._observed})
        self._worlds = DistillationWorlds(config, teacher, layouts(taught), num_threads=config.run.num_threads)
        if not resume:
            self._save_first()
        self._open_directory(resume=resume)

    def parameters(self) -> Parameters:
        """The newest Bob, as he is evaluated and published."""
        return self._distiller.averaged_parameters()

    def health(self) -> Health:
        """The state of the one actor there is, this process."""
        return self._health_of_one(num_rollouts_counted=self.iteration)

    def grid(self) -> GoalGrid:
        """The cells of random goals, and how often Bob solved those there."""
        return self._grid_of(self._cells, self._tries, self._solved / np.maximum(1, self._tries))

    def close(self) -> None:
        """Stop the worlds' threads; a second call does nothing."""
        self._worlds.close()

    def _advance(self, on_beat: OnBeat) -> None:
        """Play an episode in every world and learn from it, which is short: ``on_beat`` is never needed."""
        start = time.perf_counter()
        with self.timing("play"):
            played = self._worlds.play(NumpyMCPPolicy(self._distiller.parameters()), self._rng)
        with self.timing("learn"):
            progress = self.num_env_steps / self.config.run.total_env_steps
            learned = self._distiller.learn(played.lesson, progress, self._rng)
        self.bookkeeper.count(played.num_env_steps)
        self.directory.dump_diverged(f"{self.iteration:06d}", played.diverged)
        self._num_broken += len(played.diverged)
        self._count_goals(played.goal, played.solved)
        metrics = {f"learner/{name}": value for name, value in learned.items()}
        metrics["world/num_broken"] = float(self._num_broken)
        if len(played.solved):
            metrics["bob/success_rate"] = float(played.solved.mean())
        with self.timing("evaluate"):
            if self.bookkeeper.evaluation_due(self.iteration):
                metrics |= self._evaluate()
        elapsed_s = time.perf_counter() - start
        self.bookkeeper.wall_s += elapsed_s
        counted = {"iteration": self.iteration, "env_steps": self.num_env_steps}
        speed = {"time/wall_s": self.bookkeeper.wall_s, "time/env_steps_per_s": played.num_env_steps / elapsed_s}
        with self.timing("record"):
            self.directory.record(counted | metrics | speed)
            goals: StateArray = np.column_stack((played.start, played.goal, played.solved)).astype(np.float64)
            self.directory.record_goals(self.iteration, self.num_env_steps, goals[:NUM_RECORDED_GOALS])
            self._on_iteration(counted | metrics | speed)
        self._keep(after=self.num_env_steps - played.num_env_steps)

    def _evaluate(self) -> Metrics:
        bob, config = numpy_bob(self.parameters()), self.config
        return success_metrics(
            bob,
            config,
            EVALUATED_GOALS,
            config.run.evaluation_episodes,
            seed=EVALUATION_SEED,
            num_threads=config.run.num_threads,
        )

    def _count_goals(self, goal: StateArray, solved: np.ndarray) -> None:
        inside = (goal >= self._cells.bounds_m[0]).all(axis=1) & (goal <= self._cells.bounds_m[1]).all(axis=1)
        self._tries += self._cells.count(goal[inside])
        self._solved += self._cells.count(goal[inside & solved])

    def _teacher(self) -> NumpyMCPPolicy:
        """The Bob who is asked.

        Raises:
            TandemError: he has no primitives, or not as many as the student.
        """
        teacher = numpy_bob(self._teacher_parameters)
        if not isinstance(teacher, NumpyMCPPolicy):
            raise TandemError("--from: a monolithic Bob has no primitives to teach; name a composed one")
        num = self.config.policy.bob.num_primitives
        if teacher.num_primitives != num:
            raise TandemError(
                f"--from: the teacher has {teacher.num_primitives} primitives, and the student learns each of them: "
                f"set policy.bob.num_primitives={teacher.num_primitives}; it is {num}"
            )
        return teacher

    # --- exact resume ----------------------------------------------------------------------------------------------

    def _begin_from(self, start: Start) -> None:
        seen: Layouts = layouts(self.config.world)
        before = layouts(start.world)
        if start.world.num_observed_obstacles not in (0, num := len(self.config.world.obstacles)):
            raise TandemError(
                f"--from {start.reference}: it sees {start.world.num_observed_obstacles} obstacles, here are {num}: "
                "describe as many"
            )
        if start.world.observed.num_commands > (kept := self.config.world.num_kept_commands):
            raise TandemError(
                f"--from {start.reference}: it sees its last {start.world.observed.num_commands} commands, here worlds "
                f"remember {kept}: raise world.observed.num_commands"
            )
        said = transfer.take_over(self._distiller.student, self._teacher_parameters, before.bob, seen.bob)
        self._distiller.begin()
        _logger.info("from %s: bob/policy: %s", start.reference, said)
        if start.published is not None:
            self.directory.write_published(start.published)

    def _save(self) -> None:
        with self.timing("checkpoint"):
            parts = {
                "distiller": self._distiller.state(),
                "teacher": self._teacher_parameters,
                "cells": {"tries": self._tries, "solved": self._solved},
                "bob": dict(self.parameters()),  # for readers without torch: evaluate, render, coverage
            }
            meta = {"rng": self._rng.bit_generator.state, "teacher_observed": self._observed.model_dump(mode="json")}
            self.bookkeeper.save(parts, meta | {"num_broken": self._num_broken})

    def _load(self) -> None:
        parts, meta = self.bookkeeper.resume()
        self._distiller.load_state(parts["distiller"])
        self._teacher_parameters = parts["teacher"]
        self._observed = ObservedConfig.model_validate(meta["teacher_observed"])
        self._tries, self._solved = (np.array(parts["cells"][name]) for name in ("tries", "solved"))
        self._rng.bit_generator.state, self._num_broken = meta["rng"], int(meta.get("num_broken", 0))
