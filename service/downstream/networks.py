"""The networks of downstream learners, as Stable-Baselines3 takes them: what they see, and the MCP actor."""

from __future__ import annotations

from typing import Any

import gymnasium
import torch
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.sac.policies import LOG_STD_MAX, LOG_STD_MIN, Actor, MultiInputPolicy
from torch import Tensor

from service.config import MCPConfig
from service.downstream.vec_env import PREVIOUS
from service.envs.observations import BOB, GOAL_FROM_OBJECT
from service.policies.networks import InputNormalisation, MCPPolicy

STEP_SCALE_M = 0.02
"""Scale of movements in a step, as inputs: the hand's full speed is two to three times as much."""


class GoalFeatures(BaseFeaturesExtractor):
    """(N, 23): positions 11, goal 3, goal relative to object 3, movements of end effector 3 and object 3 in a step.

    Normalised, as for Bob's gate: metres are too small for a new network. All methods see the same.
    """

    scale: Tensor

    def __init__(self, observation_space: gymnasium.spaces.Dict) -> None:
        super().__init__(observation_space, BOB.size + 9)
        self.normalise = InputNormalisation(BOB.normalisation)
        self.register_buffer("scale", torch.tensor(GOAL_FROM_OBJECT.normalisation.scale))

    def forward(self, observations: dict[str, Tensor]) -> Tensor:
        """Features of a batch of goal observations."""
        rows = bob_input(observations)
        relative = (rows[:, BOB["goal"]] - rows[:, BOB["object"]]) / self.scale
        moved = (observations["observation"] - observations[PREVIOUS]) / STEP_SCALE_M
        moved = torch.cat((moved[:, BOB["effector"]], moved[:, BOB["object"]]), dim=1)
        return torch.cat((self.normalise(rows), relative.clamp(-5.0, 5.0), moved.clamp(-5.0, 5.0)), dim=1)


def bob_input(observations: dict[str, Tensor]) -> Tensor:
    """(N, 14) positions and goal, as Bob sees them."""
    return torch.cat((observations["observation"], observations["desired_goal"]), dim=1)


class MCPActor(Actor):
    """SAC's actor as a Multiplicative Compositional Policy: built as our Bob (``MCPConfig()``), learned end to end.

    K primitives see positions only, a gate sees the goal as well, and the product of the primitives' Gaussians, raised
    to the gate's weights, is one diagonal Gaussian (Peng et al. 2019, eq. 4; ``policies.composition``). SAC needs
    actions in [-1, 1] and their log-probabilities: that Gaussian is the one *before* the tanh, so an action is
    ``tanh(mean + std * noise)``, its log-probability has the tanh's Jacobian as in SAC's own actor, and the
    deterministic action is ``tanh(mean)``. Squashing the composition, not each primitive, keeps the product a Gaussian.
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        del self.latent_pi, self.mu, self.log_std  # SAC's own network
        assert self.action_space.shape is not None
        self.mcp = MCPPolicy(MCPConfig(), self.action_space.shape[0])

    def get_action_dist_params(self, obs: Any) -> tuple[Tensor, Tensor, dict[str, Tensor]]:
        """Mean and log-std, (N, A) each, before the tanh."""
        mean, std = self.mcp(bob_input(obs))
        return mean, std.log().clamp(LOG_STD_MIN, LOG_STD_MAX), {}


class MCPSACPolicy(MultiInputPolicy):
    """SAC's critics with an MCP actor of K = 4 primitives."""

    def make_actor(self, features_extractor: BaseFeaturesExtractor | None = None) -> MCPActor:
        """The actor; its inputs are normalised by the network itself."""
        kwargs = self._update_features_extractor(self.actor_kwargs, features_extractor)
        return MCPActor(**kwargs).to(self.device)
