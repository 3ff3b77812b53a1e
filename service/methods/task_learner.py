"""The learner of a task: soft actor-critic on its task's worlds, with hindsight where its method has it."""

from __future__ import annotations

import functools

import numpy as np
import torch

from service.base.errors import TandemError
from service.config.distillation import DistillingConfig
from service.config.self_play import MCPConfig, SelfPlayConfig
from service.config.task import TaskConfig
from service.envs.observations import POSITIONS
from service.learner.off_policy import OffPolicyLoop
from service.learner.replay import ReplayBuffer
from service.learner.sac import Batch, SACLearner
from service.learner.sac_networks import GaussianActor, MCPActor
from service.methods.task_methods import TaskMethod
from service.methods.task_worlds import TaskWorlds, columns
from service.registry.learned import learner_inputs, num_inputs
from service.registry.loading import Trained

_RELABELLED_UNTIL = 0.5
"""Progress from which on the share of relabelled goals is its last one (docs/results/log.md, T17)."""


class Hindsight:
    """Makes batches in which a share of the goals are places where the object came to later in the same episode."""

    def __init__(self, worlds: TaskWorlds, share: float) -> None:
        self.share = share
        """Of the transitions, on average (HER, ``future``); may be changed while learning."""
        self._worlds = worlds

    def __call__(self, replay: ReplayBuffer, size: int, rng: np.random.Generator) -> Batch:
        """Draw ``size`` transitions and relabel some of them."""
        places = replay.draw(size, rng)
        rows = replay.read(places)
        if self.share:
            other = rng.random(size) < self.share
            achieved = replay.column("following", replay.draw_later(places, rng))[:, POSITIONS["object"]]
            rows["goal"][other] = achieved[other]
            rows["reward"][other, 0] = self._worlds.rewards(rows["following"][other], achieved[other])
        return Batch(
            learner_inputs(rows["previous"], rows["positions"], rows["goal"], self._worlds.seen),
            rows["action"],
            rows["reward"][:, 0],
            learner_inputs(rows["before"], rows["following"], rows["goal"], self._worlds.seen),
        )


def make_loop(config: TaskConfig, method: TaskMethod, trained: Trained, worlds: TaskWorlds) -> OffPolicyLoop:
    """Make a new learner in worlds that have begun; ``loop.make_batch`` is its ``Hindsight``.

    Where an action lasts for H env steps, updates an env step and the horizon in env steps stay: H times the updates
    after each action, and a discount of ``gamma ** H``.
    """
    size, hold = worlds.num_actions, worlds.steps_per_action
    longer = {"gradient_steps": hold * config.sac.gradient_steps, "gamma": config.sac.gamma**hold}
    sac = config.sac.model_copy(update=longer)
    num_without_goal, num_seen = num_inputs(worlds.seen)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(spread_seed(config.seed, 0))
        actor = (
            MCPActor(num_without_goal, num_seen, size, _sizes_of(trained))
            if method.mcp_actor
            else GaussianActor(num_seen, size, sac.hidden_sizes)
        )
    learner = SACLearner(actor, num_seen, size, sac, spread_seed(config.seed, 1))
    num_steps = -(-config.run.total_env_steps // (sac.num_worlds * hold))  # everything is kept
    replay = ReplayBuffer(num_steps, sac.num_worlds, {**columns(worlds.seen), "action": size})
    share = method.her_ratio[0] if method.her_ratio else 0.0
    return OffPolicyLoop(worlds, replay, learner, Hindsight(worlds, share), spread_seed(config.seed, 2))


def _sizes_of(trained: Trained) -> MCPConfig:
    """Sizes of primitives and gate that are learned from nothing: those of the primitives that were named."""
    if not isinstance(trained.config, SelfPlayConfig | DistillingConfig):
        raise TandemError(f"{trained.label} has no primitives, whose sizes scratch-mcp takes: name some")
    return trained.config.policy.bob


def set_progress(loop: OffPolicyLoop, method: TaskMethod, progress: float) -> None:
    """Set the share of relabelled goals for a progress from 0, when learning begins, to 1, when it ends."""
    if method.her_ratio is not None:
        first, last = method.her_ratio
        assert isinstance(loop.make_batch, Hindsight)
        loop.make_batch.share = first + (last - first) * min(1.0, progress / _RELABELLED_UNTIL)


@functools.cache
def spread_seed(seed: int, purpose: int) -> int:
    """A seed far from those of other trials: world i gets it plus i, so neighbours would share nearly all episodes."""
    return int(np.random.SeedSequence((seed, purpose)).generate_state(1)[0]) >> 1
