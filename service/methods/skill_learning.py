"""Skills in worlds: a vector z for every episode, and batches that are paid by an intrinsic reward."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import gymnasium
import numpy as np
import torch

from service.base.types import Array, Arrays, BoolArray, FloatArray
from service.base.user_code import naming_unexpected, origin_of
from service.config import WorkspaceConfig
from service.config.skills import SkillDiscoveryConfig, SkillsConfig
from service.envs.gym.vector import TabletopVectorEnv
from service.envs.observations import POSITIONS
from service.generator.validity import in_workspace
from service.learner.off_policy import OffPolicyLoop, TabletopWorlds
from service.learner.replay import Columns, ReplayBuffer
from service.learner.sac import Batch, SACLearner
from service.learner.sac_networks import GaussianActor
from service.methods.intrinsic_reward import IntrinsicReward
from service.methods.rewards import find_reward
from service.policies.frozen_skills import draw_skills, normalised_place, skill_inputs
from service.policies.numpy_actor import NUM_MOTION_INPUTS

_OBJECT = POSITIONS["object"]
_STEP_COLUMNS = {"previous": POSITIONS.size, "positions": POSITIONS.size, "following": POSITIONS.size}
_COLUMNS = {**_STEP_COLUMNS, "start": 3}
STATE_SIZE = 3
"""Of what rewards see: the object's position."""


class SkillWorlds(TabletopWorlds):
    """Worlds in which every episode has a skill; their goals mean nothing.

    Args:
        env: see ``TabletopWorlds``.
        seed: of episodes and skills.
        config: of the method.
    """

    def __init__(self, env: gymnasium.vector.VectorEnv[Any, Any, Any], seed: int, config: SkillsConfig) -> None:
        super().__init__(env, seed)
        self._rng, self._config = np.random.default_rng(seed), config
        self.skill = self._draw()
        """(N, Z) of the episodes that go on."""
        self.finished: list[FloatArray] = []
        """(3, 3) where the object was when an episode began, at its highest and at its end, metres, since this list was
        last cleared."""
        self._start = self.positions[:, _OBJECT]
        self._highest = self._start

    def inputs(self) -> FloatArray:
        """(N, 17 + Z) what the actor sees now."""
        return skill_inputs(self.previous, self.positions, self.skill)

    def step(self, actions: FloatArray) -> tuple[Columns, BoolArray]:
        """Act by (N, 4) actions; the transitions and (N,) whose episodes ended."""
        step, skill, start = self.advance(actions), self.skill, self._start
        now = step.following[:, _OBJECT]
        self._highest = np.where(now[:, 2:] > self._highest[:, 2:], now, self._highest)
        if step.ended.any():
            self.skill = np.where(step.ended[:, None], self._draw(), skill)
            self.finished += list(np.stack((self._start, self._highest, now), axis=1)[step.ended])
            begun = self.positions[:, _OBJECT]
            self._start, self._highest = (
                np.where(step.ended[:, None], begun, place) for place in (self._start, self._highest)
            )
        seen = {name: getattr(step, name) for name in _STEP_COLUMNS}
        return {**seen, "start": start, "skill": skill, "action": actions}, step.ended

    def state(self) -> tuple[Arrays, Any]:
        """Copy everything that ``load_state`` needs."""
        arrays, random = super().state()
        arrays |= {"skill": self.skill.copy(), "start": self._start.copy(), "highest": self._highest.copy()}
        return arrays, [random, self._rng.bit_generator.state]

    def load_state(self, arrays: dict[str, Array], random: Any) -> None:
        """Go back to a saved state; continues bit-identically."""
        worlds = dict(arrays)
        self.skill, self._start, self._highest = (
            np.array(worlds.pop(name), dtype=np.float32) for name in ("skill", "start", "highest")
        )
        self._rng.bit_generator.state = random[1]
        super().load_state(worlds, random[0])

    def _draw(self) -> FloatArray:
        return draw_skills(self._config.prior, self.num_worlds, self._config.size, self._rng)


class Seen(NamedTuple):
    """What a reward and an actor see of B transitions."""

    before: FloatArray
    """(B, S) state that the reward sees."""
    after: FloatArray
    """(B, S)"""
    stepped: BoolArray
    """(B,) whether the world came from one to the other in a step."""
    inputs: FloatArray
    """(B, I) of the actor."""
    next_inputs: FloatArray
    """(B, I)"""


class IntrinsicBatches:
    """Makes batches that an intrinsic reward pays, after it has learned from others.

    Args:
        reward: of the method.
        config: of the method.
        see: says what is seen of the transitions in a replay buffer, which has columns ``skill`` and ``action``, too.
    """

    def __init__(self, reward: IntrinsicReward, config: SkillsConfig, see: Callable[[Columns], Seen]) -> None:
        self.reward, self._config, self._see = reward, config, see
        self._origin = origin_of(type(reward))
        self.losses: list[float] = []
        """Of the reward's network, since this list was last cleared."""

    def __call__(self, replay: ReplayBuffer, size: int, rng: np.random.Generator) -> Batch:
        """Draw ``size`` transitions."""
        newest = max(1, self._config.newest_steps // replay.num_worlds)
        for _ in range(self._config.gradient_steps):
            rows = replay.read(replay.draw(self._config.batch_size, rng, newest=newest))
            steps = _tensors(self._see(rows), rows["skill"], jumps=False)
            with naming_unexpected(self._origin):
                self.losses.append(self.reward.learn(*steps))
        rows = replay.read(replay.draw(size, rng))
        seen = self._see(rows)
        steps = _tensors(seen, rows["skill"], jumps=self.reward.pays_jumps)
        with naming_unexpected(self._origin):
            paid: FloatArray = self.reward.rewards(*steps).numpy()
        weights = rows["skill"] if self.reward.pays_features else None
        return Batch(seen.inputs, rows["action"], paid, seen.next_inputs, weights)


def make_skill_loop(config: SkillDiscoveryConfig) -> tuple[OffPolicyLoop, SkillWorlds, IntrinsicBatches]:
    """Make the loop of a skill-discovery run, its worlds, which have to be closed, and what makes its batches."""
    skills = config.skills
    seeds = [int(seed) for seed in np.random.SeedSequence(config.seed).generate_state(5) >> 1]
    reward = find_reward(skills.method, config.code)(skills, STATE_SIZE, seeds[0])
    env = TabletopVectorEnv(
        skills.sac.num_worlds,
        config.world,
        max_episode_steps=skills.episode_steps,
        num_threads=config.run.num_threads,
    )
    worlds = SkillWorlds(env, seeds[1], skills)
    num_inputs, num_actions = NUM_MOTION_INPUTS + skills.size, worlds.num_actions
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seeds[2])
        actor = GaussianActor(num_inputs, num_actions, skills.sac.hidden_sizes)
    num_features = skills.size if reward.pays_features else None
    learner = SACLearner(actor, num_inputs, num_actions, skills.sac, seeds[3], num_features)
    columns = {**_COLUMNS, "skill": skills.size, "action": num_actions}
    num_steps = -(-min(skills.replay_steps, config.run.total_env_steps) // skills.sac.num_worlds)
    replay = ReplayBuffer(num_steps, skills.sac.num_worlds, columns)
    batches = IntrinsicBatches(reward, skills, functools.partial(see_object, workspace=config.world.workspace))
    return OffPolicyLoop(worlds, replay, learner, batches, seeds[4]), worlds, batches


def see_object(rows: Columns, workspace: WorkspaceConfig) -> Seen:
    """The object's position for the reward; for the actor positions, movements and the skill.

    An object outside the workspace is seen where it was when the episode began: to lose it gives back what moving it
    has earned. Else the longest way of all would be that of a cube pushed off the table, which falls for ever.
    """
    previous, positions, following, start, skill = (rows[name] for name in (*_COLUMNS, "skill"))
    seen: list[FloatArray] = []
    stepped: BoolArray = np.ones(len(start), dtype=np.bool_)
    for place in (positions[:, _OBJECT], following[:, _OBJECT]):
        inside = in_workspace(place, workspace)
        seen.append(normalised_place(np.where(inside[:, None], place, start)))
        stepped &= inside
    inputs = skill_inputs(previous, positions, skill), skill_inputs(positions, following, skill)
    return Seen(seen[0], seen[1], stepped, *inputs)


def _tensors(seen: Seen, skill: FloatArray, *, jumps: bool) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """States before and after, and skills; without ``jumps``, what came from one to the other in no step stays."""
    after = seen.after if jumps else np.where(seen.stepped[:, None], seen.after, seen.before)
    return torch.from_numpy(seen.before), torch.from_numpy(after), torch.from_numpy(skill)
