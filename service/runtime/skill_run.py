"""The runner of the skill-discovery baselines: one process, records and checkpoints as of self-play."""

from __future__ import annotations

import time

import numpy as np

from service.actors.coverage import NUM_SKILLS, visited_share
from service.actors.evaluation import EVALUATION_SEED
from service.baselines.coverage import skill_paths
from service.baselines.frozen import FrozenSkills, export_skills
from service.baselines.skills import IntrinsicBatches, SkillWorlds, make_skill_loop
from service.config import Config
from service.generator.bins import GoalCells, in_air
from service.io.run_directory import RunDirectory
from service.io.tensors import join_parts, split_parts
from service.policies.parameters import Parameters
from service.runtime.runner import Health, OnBeat, Runner
from service.store.models import GoalGrid
from service.types import Metrics


class SkillRun(Runner):
    """A skill-discovery run in this process; an iteration is an episode of every world.

    Args:
        config: the run, with ``skills``.
        directory: where it keeps everything; see ``RunDirectory``.
        resume: continue from the newest checkpoint instead of starting anew.

    Raises:
        TandemError: see ``RunDirectory.claim``.
        CheckpointError: ``resume`` without a usable checkpoint.
    """

    def __init__(self, config: Config, directory: RunDirectory, *, resume: bool = False) -> None:
        directory.claim(resume=resume)
        super().__init__(config, directory)
        assert config.skills is not None
        self._skills = config.skills
        self._loop = make_skill_loop(config)
        assert isinstance(self._loop.worlds, SkillWorlds)
        assert isinstance(self._loop.make_batch, IntrinsicBatches)
        self._worlds, self._batches = self._loop.worlds, self._loop.make_batch
        self._cells = GoalCells(config.world, config.generator.cell_size_m)
        self._visits = np.zeros(len(self._cells), dtype=np.int64)  # ends of episodes that moved the object
        if resume:
            self._load()
        else:
            self._save_first()
        self._open_directory(resume=resume)

    def parameters(self) -> Parameters:
        """The newest skills: the averaged actor, and the network that rewards come from."""
        return export_skills(self._loop.learner.averaged_parameters(), self._batches.reward.exported())

    def health(self) -> Health:
        """The state of the one actor there is, this process."""
        return self._health_of_one(num_rollouts_counted=self.iteration)

    def grid(self) -> GoalGrid:
        """The cells into which episodes brought the object; nobody tries goals, so success says nothing."""
        return self._grid_of(self._cells, self._visits, np.full(len(self._cells), 0.5))

    def close(self) -> None:
        """Stop the worlds' threads; a second call does nothing."""
        self._worlds.close()

    def _advance(self, on_beat: OnBeat) -> None:
        """Play an episode in every world, which is short: ``on_beat`` is never needed."""
        start, before = time.perf_counter(), self._loop.num_env_steps
        with self.timing("play and learn"):
            learned = self._loop.play(self._worlds.num_worlds * self._skills.episode_steps)
        num_env_steps = self._loop.num_env_steps - before
        self.bookkeeper.count(num_env_steps)
        metrics = {f"learner/{name}": value for name, value in learned.items()} | self._episodes()
        if self._batches.losses:
            metrics["learner/representation_loss"] = float(np.mean(self._batches.losses))
            self._batches.losses.clear()
        with self.timing("evaluate"):
            if self.bookkeeper.evaluation_due(self.iteration):
                metrics |= self._evaluate()
        elapsed_s = time.perf_counter() - start
        self.bookkeeper.wall_s += elapsed_s
        counted = {"iteration": self.iteration, "env_steps": self.num_env_steps}
        speed = {"time/wall_s": self.bookkeeper.wall_s, "time/env_steps_per_s": num_env_steps / elapsed_s}
        with self.timing("record"):
            self.directory.record(counted | metrics | speed)
            self._on_iteration(counted | metrics | speed)
        self._keep(after=self.num_env_steps - num_env_steps)

    def _episodes(self) -> Metrics:
        """What the episodes that ended did to the object."""
        if not self._worlds.finished:
            return {}
        start, end = np.stack(self._worlds.finished).astype(np.float64).swapaxes(0, 1)
        self._worlds.finished.clear()
        distance = np.linalg.norm(end - start, axis=1)
        lower, upper = self._cells.bounds_m
        inside = ((end >= lower) & (end <= upper)).all(axis=1)
        moved = inside & (distance > self.config.game.success_distance_m)
        self._visits += self._cells.count(end[moved])
        lifted = inside & in_air(end, self.config.world.rest_height_m)
        return {
            "skills/moved_fraction": float(moved.mean()),
            "skills/outside_fraction": float((~inside).mean()),
            "skills/lifted_fraction": float(lifted.mean()),
            "skills/distance_m": float(distance[inside].mean()) if inside.any() else 0.0,
            "skills/num_cells_seen": float(np.count_nonzero(self._visits)),
        }

    def _evaluate(self) -> Metrics:
        """Coverage of random skills without noise."""
        skills = FrozenSkills(self.parameters(), self._skills.method)
        paths = skill_paths(
            skills,
            self.config.world,
            num_skills=NUM_SKILLS,
            num_steps=self._skills.episode_steps,
            seed=EVALUATION_SEED,
            num_threads=self.config.run.num_threads,
        )
        return {"evaluation/coverage": visited_share(paths, self.config.world.workspace)}

    # --- exact resume ----------------------------------------------------------------------------------------------

    def _save(self) -> None:
        with self.timing("checkpoint"):
            arrays, values = self._loop.state()
            reward = {f"reward/{name}": array for name, array in self._batches.reward.state().items()}
            parts = {"loop": {**arrays, **reward}, "skills": dict(self.parameters()), "visits": {"cells": self._visits}}
            self.bookkeeper.save(parts, {"loop": values})

    def _load(self) -> None:
        parts, meta = self.bookkeeper.resume()
        loop = split_parts(parts["loop"])
        self._batches.reward.load_state(loop.pop("reward"))
        self._loop.load_state(join_parts(loop), meta["loop"])
        self._visits = np.array(parts["visits"]["cells"])
