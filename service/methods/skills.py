"""Skill discovery: an intrinsic reward teaches a policy that a skill vector steers.

An iteration is an episode of every world.
"""

from __future__ import annotations

from collections.abc import Mapping
from inspect import getfile
from pathlib import Path

import numpy as np
import torch

from service.actors.evaluation import EVALUATION_SEED
from service.base.errors import ConfigError
from service.base.tensors import join_parts, split_parts
from service.base.types import Metrics
from service.base.user_code import CodeError, check_members, checked, naming_errors_of, recorded
from service.config import parse_config
from service.config.skills import SKILLS_OF, SkillDiscoveryConfig, SkillsConfig
from service.generator.bins import GoalCells, in_air
from service.generator.validity import in_workspace
from service.methods.intrinsic_reward import IntrinsicReward
from service.methods.method import Iteration, Method, State, goal_grid
from service.methods.rewards import find_reward
from service.methods.skill_learning import STATE_SIZE, make_skill_loop
from service.policies.forward import prepared, relu_layers
from service.policies.frozen_skills import export_skills
from service.policies.parameters import Parameters
from service.registry.loading import Trained
from service.registry.publishing import measure_skills
from service.store.models import GoalGrid

_REPLACEABLE = (
    "prior", "zero_shot", "pays_jumps", "pays_features", "make_network", "loss", "paid", "learned", "tensors",
)  # fmt: skip
"""What a reward of a user's may have of its own."""


class SkillDiscovery(Method):
    """LSD, METRA, DADS, DIAYN, CSF, or a method of a user's.

    Args:
        config: the run.
    """

    def __init__(self, config: SkillDiscoveryConfig) -> None:
        super().__init__()
        torch.set_num_threads(1)  # updates are small; ``run.num_threads`` are for the worlds
        self._config, self._skills = config, config.skills
        self._loop, self._worlds, self._batches = make_skill_loop(config)
        self._cells = GoalCells(config.world)
        self._visits = np.zeros(len(self._cells), dtype=np.int64)  # ends of episodes that moved the object

    def step(self) -> Iteration:
        """Play an episode in every world, with its updates."""
        before = self._loop.num_env_steps
        with self.timing("play and learn"):
            learned = self._loop.play(self._worlds.num_worlds * self._skills.episode_steps)
        metrics = self.count(self._loop.num_env_steps - before)
        metrics |= {f"learner/{name}": value for name, value in learned.items()} | self._episodes()
        if self._batches.losses:
            metrics["learner/representation_loss"] = float(np.mean(self._batches.losses))
            self._batches.losses.clear()
        return Iteration(metrics)

    def evaluate(self) -> Metrics:
        """Coverage of random skills without noise."""
        found = measure_skills(self._config, self.parameters(), EVALUATION_SEED)
        return {f"evaluation/{name}": value for name, value in found.items()}

    def measure(self) -> Metrics:
        """Coverage of random skills that chose nothing, without noise."""
        return measure_skills(self._config, self.parameters())

    def parameters(self) -> Parameters:
        """The newest skills: the averaged actor, and the network that rewards come from."""
        return export_skills(self._loop.learner.averaged_parameters(), self._batches.reward.exported())

    def grid(self) -> GoalGrid:
        """The cells into which episodes brought the object; no goals are tried, so success says nothing."""
        visits, rates = self._visits, np.full(len(self._cells), 0.5)
        return goal_grid(self._cells, np.flatnonzero(visits), visits, rates, self.iteration, self.num_env_steps)

    def close(self) -> None:
        """Stop the worlds' threads; a second call does nothing."""
        self._worlds.close()

    def state(self) -> State:
        """The off-policy loop with its replay buffer, the reward's network, and the visits."""
        arrays, values = self._loop.state()
        return {
            "loop": arrays | join_parts({"reward": self._batches.reward.state()}),
            "skills": dict(self.parameters()),  # for readers without torch
            "visits": {"cells": self._visits},
            "random": values,
        }

    def load_state(self, state: State) -> None:
        """Continue, bit for bit, where ``state`` gave these."""
        loop = split_parts(state["loop"])
        self._batches.reward.load_state(loop.pop("reward"))
        self._loop.load_state(join_parts(loop), state["random"])
        self._visits = np.array(state["visits"]["cells"])

    def _episodes(self) -> Metrics:
        """What the episodes that ended did to the object."""
        if not self._worlds.finished:
            return {}
        start, highest, end = np.stack(self._worlds.finished).astype(np.float64).swapaxes(0, 1)
        self._worlds.finished.clear()
        distance = np.linalg.norm(end - start, axis=1)
        inside = in_workspace(end, self._config.world.workspace)
        moved = inside & (distance > self._config.success_distance_m)
        self._visits += self._cells.count(self._cells.index(end[moved]))
        lifted, raised = (in_air(place, self._config.world.rest_height_m) for place in (end, highest))
        return {
            "skills/moved_fraction": float(moved.mean()),
            "skills/outside_fraction": float((~inside).mean()),
            "skills/lifted_fraction": float((inside & lifted).mean()),
            "skills/raised_fraction": float(raised.mean()),
            "skills/distance_m": float(distance[inside].mean()) if inside.any() else 0.0,
            "skills/num_cells_seen": float(np.count_nonzero(self._visits)),
        }


def begin(config: SkillDiscoveryConfig, registry: Path | str, start_from: Trained | None) -> SkillDiscoveryConfig:
    """The configuration, with the text of a reward of a user's, and what those who act need to know of it.

    Raises:
        ConfigError: it cannot begin from what another run has learned, or the reward does not run.
    """
    if start_from is not None:
        raise ConfigError("--from is for self-play; skill discovery begins anew: leave it out")
    if (steps := config.run.total_env_steps) <= (starts := config.skills.sac.learning_starts):
        raise ConfigError(
            f"run.total_env_steps = {steps}, and learning begins after {starts} env steps: raise it, or lower "
            "skills.sac.learning_starts"
        )
    if config.skills.method in SKILLS_OF:
        return config
    tree, code = config.model_dump(mode="json"), recorded(config.skills.method, config.code)
    found = check_reward(config.skills, code)
    said = {"prior": found.prior, "zero_shot": found.zero_shot}
    for key, value in said.items():
        if key in config.skills.model_fields_set and (asked := getattr(config.skills, key)) != value:
            raise ConfigError(f"skills.{key} = {asked!r}: {config.skills.method} says {value!r}; leave it out")
    exact = parse_config({**tree, "code": code, "skills": {**tree["skills"], **said}}, where=config.skills.method)
    assert isinstance(exact, SkillDiscoveryConfig)
    return exact


def check_reward(config: SkillsConfig, code: Mapping[str, str]) -> IntrinsicReward:
    """Try a user's reward on random batches as large as in learning, and what is exported of it.

    Raises:
        CodeError: it raises, gives another shape, numbers that are not finite, or a network that cannot be exported.
    """
    kind = find_reward(config.method, code)
    origin = getfile(kind)
    check_members(kind, IntrinsicReward, _REPLACEABLE)
    if all(getattr(kind, name) is getattr(IntrinsicReward, name) for name in ("loss", "paid", "make_network")):
        raise CodeError(f"{origin}: {kind.__name__} has neither loss nor paid nor make_network: give one of them")
    random = torch.Generator().manual_seed(0)

    def drawn(num: int) -> list[torch.Tensor]:
        return [torch.randn(num, size, generator=random) for size in (STATE_SIZE, STATE_SIZE, config.size)]

    taught, judged = drawn(config.batch_size), drawn(config.sac.batch_size)
    where = f"{origin}: {kind.__name__}"
    with naming_errors_of(origin):
        reward, again = (kind(config, STATE_SIZE, seed) for seed in (0, 1))
        _check_tensors(where, reward.rewards(*judged), reward.loss(*taught), config, kind)
        loss, paid = reward.learn(*taught), reward.rewards(*judged).numpy()
        again.load_state(reward.state())
        resumes = again.learn(*taught) == reward.learn(*taught)
        layers = prepared(np, {f"n.{name}": array for name, array in reward.exported().items()}).get("n", [])
        rows = torch.randn(8, len(layers[0][0]) if layers else STATE_SIZE, generator=random)
        with torch.no_grad():
            found = reward.network(rows).numpy()
    num = config.sac.batch_size
    checked(f"{where}.loss", np.array(loss), ())  # first: what has learned from a wrong one pays wrongly
    checked(f"{where}.paid", paid, (num, config.size) if reward.pays_features else (num,))
    if not resumes:
        raise CodeError(f"{where}: goes on otherwise after load_state(state()): tensors() has to have all that changes")
    if not layers or not np.allclose(relu_layers(np, layers, rows.numpy()), found, atol=1e-4):
        raise CodeError(f"{where}.make_network: only torch.nn.Linear with torch.nn.ReLU between them can be exported")
    if reward.zero_shot != "none" and (rows.shape[1], found.shape[1]) != (STATE_SIZE, config.size):
        raise CodeError(
            f"{where}.make_network: maps {rows.shape[1]} numbers to {found.shape[1]}; with zero_shot = "
            f"{reward.zero_shot!r} it has to map the {STATE_SIZE} of a place to the {config.size} of a skill: do so, "
            "or set zero_shot = 'none'"
        )
    return reward


def _check_tensors(where: str, paid: object, loss: object, config: SkillsConfig, kind: type[IntrinsicReward]) -> None:
    """Check what torch would only say in words of its own."""
    for name, given in (("paid", paid), ("loss", loss)):
        if not isinstance(given, torch.Tensor):
            raise CodeError(f"{where}.{name} gave a {type(given).__name__}; give a torch.Tensor")
    assert isinstance(paid, torch.Tensor)
    assert isinstance(loss, torch.Tensor)
    if loss.dim():
        raise CodeError(f"{where}.loss gave shape {list(loss.shape)}; give one number, such as its mean()")
    if not loss.requires_grad:
        raise CodeError(f"{where}.loss does not depend on the network that it is to teach: use self.network in it")
    if paid.dim() == 2 and paid.shape[1] == config.size and not kind.pays_features:
        raise CodeError(f"{where}.paid gave shape {list(paid.shape)}; give [{len(paid)}], or set pays_features = True")


def make(config: SkillDiscoveryConfig, registry: Path | str, start_from: Trained | None) -> SkillDiscovery:
    """Make skill discovery."""
    return SkillDiscovery(config)
