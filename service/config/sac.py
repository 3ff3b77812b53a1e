"""Settings of soft actor-critic."""

from __future__ import annotations

from pydantic import Field, PositiveInt

from service.config.frozen import FrozenModel


class SACConfig(FrozenModel):
    """Soft actor-critic on many worlds: every world makes a step, then there are several large updates."""

    num_worlds: int = Field(64, ge=1)
    gradient_steps: int = Field(
        8, ge=1, description="updates after a step of every world; 16 learn no more (docs/results)"
    )
    batch_size: int = Field(256, ge=1)
    learning_rate: float = Field(1e-3, gt=0.0, description="rl-zoo for Panda and Fetch")
    gamma: float = Field(0.95, gt=0.0, lt=1.0, description="rl-zoo; a horizon of 20 of the 50 steps")
    tau: float = Field(0.05, gt=0.0, le=1.0, description="rl-zoo")
    initial_entropy_coefficient: float = Field(
        0.1, gt=0.0, description="adapted from there; SB3 starts at 1, which drowns the first rewards"
    )
    learn_entropy_coefficient: bool = Field(True, description="towards the target entropy; or else it stays")
    target_entropy: float = Field(-1.0, description="for each action; Haarnoja et al. 2018")
    hidden_sizes: tuple[PositiveInt, ...] = Field(
        (256, 256), min_length=1, description="actor and critics; an MCP actor has its own"
    )
    critic_layer_norm: bool = Field(
        True,
        description="normalise the critics' hidden layers (Ball et al. 2023): sooner learned (docs/results, T17)",
    )
    learning_starts: int = Field(6_400, ge=0, description="env steps of uniform actions first; more than an episode")
