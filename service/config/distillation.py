"""Settings of learning from a teacher in worlds whose errors he does not see."""

from __future__ import annotations

from typing import ClassVar, Literal, Self

from pydantic import Field, model_validator

from service.config.frozen import FrozenModel
from service.config.run import Config
from service.config.self_play import PolicyConfig


class DistillationConfig(FrozenModel):
    """Privileged distillation: a trained Bob, the teacher, sees the world as it will be when a command counts.

    The student acts, by what a robot sees, and learns what the teacher would have done: DAgger (Ross et al. 2011) with
    a teacher that cheats (Chen et al. 2019).
    """

    num_worlds: int = Field(240, ge=1, description="worlds stepped together")
    episode_steps: int = Field(50, ge=2, description="env steps of an episode")
    random_fraction: float = Field(
        0.3,
        ge=0.0,
        lt=1.0,
        description="share of episodes in which random weights compose the primitives: what is composed downstream "
        "goes where Bob himself does not",
    )
    action_noise: float = Field(
        0.3, ge=0.0, le=1.0, description="std of noise on every second action of a world: it leaves the usual path"
    )
    gradient_steps: int = Field(40, ge=1, description="after an episode of every world")
    batch_size: int = Field(1024, ge=1, description="steps of a gradient step")
    learning_rate: float = Field(1e-3, gt=0.0, description="falls to a fiftieth, linearly")
    ema_decay: float = Field(
        0.9, ge=0.0, lt=1.0, description="what is evaluated and published is a moving average over iterations"
    )
    blocked_gripper_fraction: float = Field(
        0.0, ge=0.0, lt=1.0, description="share of episodes in which the gripper stays closed, as the teacher had it"
    )


class DistillingConfig(Config):
    """Distillation: a student Bob learns from the Bob of --from, who observes without delay and noise."""

    made_in: ClassVar[str] = "service.methods.distillation"
    makes: ClassVar[Literal["primitives"]] = "primitives"
    part: ClassVar[str] = "bob"

    method: Literal["distillation"] = "distillation"
    policy: PolicyConfig = PolicyConfig()
    distillation: DistillationConfig = DistillationConfig()

    @model_validator(mode="after")
    def _it_is_of_primitives(self) -> Self:
        if self.policy.monolithic_bob is not None:
            raise ValueError("distillation teaches primitives: leave out policy.monolithic_bob")
        return self
