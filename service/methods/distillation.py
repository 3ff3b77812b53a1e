"""Privileged distillation: Bob learns from a teacher who sees more; an iteration is an episode of every world."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
import torch

from service.actors.distillation import DistillationWorlds
from service.actors.evaluation import EVALUATION_SEED, evaluated_goals, success_metrics
from service.base.errors import TandemError
from service.base.types import Arrays, Metrics, StateArray
from service.config.distillation import DistillingConfig
from service.config.world import ObservedConfig
from service.envs.observations import each_object, layouts
from service.generator.bins import GoalCells
from service.generator.validity import in_workspace
from service.learner import transfer
from service.learner.distillation import Distiller
from service.methods.method import Iteration, Method, State, goal_grid
from service.policies import networks
from service.policies.numpy_policy import NumpyMCPPolicy, numpy_bob
from service.policies.parameters import Parameters
from service.registry.loading import Trained
from service.registry.publishing import measure_bob
from service.store.models import GoalGrid

NUM_RECORDED_GOALS = 32
"""Goals of each iteration that the run directory keeps."""
_logger = logging.getLogger(__name__)


class Distillation(Method):
    """DAgger with a teacher who sees the world as it will be when a command counts.

    Args:
        config: the run.
        start_from: the teacher, from whom the student begins as well; None for a run that is resumed, which has him
            in its checkpoint.

    Raises:
        TandemError: a teacher without primitives, or who does not fit.
    """

    def __init__(self, config: DistillingConfig, start_from: Trained | None = None) -> None:
        super().__init__()
        torch.set_num_threads(1)  # updates are small; ``run.num_threads`` are for the worlds
        self._config, self._start_from = config, start_from
        with torch.random.fork_rng(devices=[]):
            torch.default_generator.manual_seed(config.seed)
            self._distiller = Distiller(
                networks.MCPPolicy(config.policy.bob, layouts=layouts(config.world)), config.distillation
            )
        self._rng = np.random.default_rng(config.seed)
        self._cells = GoalCells(config.world)
        self._tries, self._solved = (np.zeros(len(self._cells), dtype=np.int64) for _ in range(2))
        self._teacher: Arrays = {}
        self._observed = ObservedConfig()
        self._worlds: DistillationWorlds | None = None

    def start(self, state: State | None = None) -> None:
        """Begin with the teacher of ``start_from``, or continue from a state."""
        if state is not None:
            self.load_state(state)
            return
        if self._start_from is None:
            raise TandemError("distillation learns from a trained Bob: name him, --from NAME@ALIAS")
        self._take_over(self._start_from)
        self._meet_teacher(dict(self._start_from.parameters), self._start_from.world.observed)

    def step(self) -> Iteration:
        """Play an episode in every world, and learn from it."""
        assert self._worlds is not None
        with self.timing("play"):
            played = self._worlds.play(NumpyMCPPolicy(self._distiller.parameters()), self._rng)
        with self.timing("learn"):
            progress = self.num_env_steps / self._config.run.total_env_steps
            learned = self._distiller.learn(played.lesson, progress, self._rng)
        metrics = self.count(played.num_env_steps)
        self._count_goals(played.goal, played.solved)
        metrics |= {f"learner/{name}": value for name, value in learned.items()}
        metrics["world/num_broken"] = float(len(played.diverged))
        if len(played.solved):
            metrics["bob/success_rate"] = float(played.solved.mean())
        goals: StateArray = np.column_stack((played.start, played.goal, played.solved)).astype(np.float64)
        diverged = {f"{self.iteration:06d}": played.diverged} if played.diverged else {}
        return Iteration(metrics, goals[:NUM_RECORDED_GOALS], diverged)

    def evaluate(self) -> Metrics:
        """Bob's success on the run's goals without noise."""
        run = self._config.run
        return success_metrics(
            numpy_bob(self.parameters()),
            self._config,
            evaluated_goals(self._config.world, self._config.success_distance_m),
            run.evaluation_episodes,
            seed=EVALUATION_SEED,
            num_threads=run.num_threads,
        )

    def measure(self) -> Metrics:
        """Success of the newest Bob on every kind of goals."""
        return measure_bob(self._config, self.parameters())

    def parameters(self) -> Parameters:
        """The newest Bob, as he is evaluated and published."""
        return self._distiller.averaged_parameters()

    def grid(self) -> GoalGrid:
        """The cells of random goals, and how often Bob solved those there."""
        tries, rates = self._tries, self._solved / np.maximum(1, self._tries)
        return goal_grid(self._cells, np.flatnonzero(tries), tries, rates, self.iteration, self.num_env_steps)

    def close(self) -> None:
        """Stop the worlds' threads; a second call does nothing."""
        if self._worlds is not None:
            self._worlds.close()

    def state(self) -> State:
        """Student, teacher, counts and random numbers."""
        return {
            "distiller": self._distiller.state(),
            "teacher": self._teacher,
            "cells": {"tries": self._tries, "solved": self._solved},
            "bob": dict(self.parameters()),  # for readers without torch: evaluate, render, coverage
            "rng": self._rng.bit_generator.state,
            "teacher_observed": self._observed.model_dump(mode="json"),
        }

    def load_state(self, state: State) -> None:
        """Continue, bit for bit, where ``state`` gave these."""
        self._distiller.load_state(state["distiller"])
        self._tries, self._solved = (np.array(state["cells"][name]) for name in ("tries", "solved"))
        self._rng.bit_generator.state = state["rng"]
        self._meet_teacher(dict(state["teacher"]), ObservedConfig.model_validate(state["teacher_observed"]))

    def _count_goals(self, goal: StateArray, solved: np.ndarray) -> None:
        inside = in_workspace(each_object(goal), self._config.world.workspace).all(axis=1)
        self._tries += self._cells.count(self._cells.index(goal[inside]))
        self._solved += self._cells.count(self._cells.index(goal[inside & solved]))

    def _meet_teacher(self, parameters: Arrays, observed: ObservedConfig) -> None:
        """Make the worlds in which the teacher is asked.

        Raises:
            TandemError: he has no primitives, or not as many as the student.
        """
        self._teacher, self._observed = parameters, observed
        teacher = numpy_bob(parameters)
        if not isinstance(teacher, NumpyMCPPolicy):
            raise TandemError("--from: a monolithic Bob has no primitives to teach; name a composed one")
        num = self._config.policy.bob.num_primitives
        if teacher.num_primitives != num:
            raise TandemError(
                f"--from: the teacher has {teacher.num_primitives} primitives, and the student learns each of them: "
                f"set policy.bob.num_primitives={teacher.num_primitives}; it is {num}"
            )
        taught = self._config.world.model_copy(update={"observed": observed})
        threads = self._config.run.num_threads
        self._worlds = DistillationWorlds(self._config, teacher, layouts(taught), num_threads=threads)

    def _take_over(self, start: Trained) -> None:
        """Begin with the teacher's parameters, as far as they fit."""
        world = self._config.world
        if (there := start.world.num_objects) != (here := world.num_objects):
            raise TandemError(
                f"--from {start.reference}: it was trained in a world of {there} object{'s' * (there > 1)}, and this "
                f"run has {here}: name what was trained in such a world"
            )
        if start.world.num_observed_obstacles not in (0, num := len(world.obstacles)):
            raise TandemError(
                f"--from {start.reference}: it sees {start.world.num_observed_obstacles} obstacles, here are {num}: "
                "describe as many"
            )
        if start.world.observed.num_commands > (kept := world.num_kept_commands):
            raise TandemError(
                f"--from {start.reference}: it sees its last {start.world.observed.num_commands} commands, here worlds "
                f"remember {kept}: raise world.observed.num_commands"
            )
        before, seen, given = layouts(start.world), layouts(world), start.networks["bob/policy"]
        if before.alike != seen.alike:
            raise TandemError(
                f"--from {start.reference}: in its world other objects are alike than here, so it sees them in another "
                "order; leave world.objects as it was"
            )
        said = transfer.take_over(self._distiller.student, given, before, seen, transfer.BOB_INPUTS)
        self._distiller.begin()
        _logger.info("from %s: bob/policy: %s", start.reference, said)


def make(config: DistillingConfig, registry: Path | str, start_from: Trained | None) -> Distillation:
    """Make distillation; ``start_from`` is the teacher."""
    return Distillation(config, start_from)
