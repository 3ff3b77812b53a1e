"""Configuration of soft actor-critic, and of skill discovery by it: LSD, DIAYN, DADS, METRA, CSF, or a user's own."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, Literal, Self

from pydantic import Field, PositiveInt, model_validator

from service.base.user_code import parse_reference
from service.config.frozen import FrozenModel
from service.config.run import Config
from service.config.world import ObservedConfig

Prior = Literal["normal", "sphere", "uniform"]
"""Of skills: N(0, I), uniform on the unit sphere, uniform in [-1, 1]."""
ZeroShot = Literal["way", "place", "none"]
"""The skill that leads to a goal: the way to it in the network's outputs, the outputs there, or none."""


SKILLS_OF: Mapping[str, tuple[Prior, ZeroShot]] = {
    "lsd": ("normal", "way"),
    "dads": ("uniform", "none"),
    "diayn": ("normal", "place"),
    "metra": ("sphere", "way"),
    "csf": ("sphere", "way"),
}
"""What the classes of the rewards say, for those who act without them."""


class SACConfig(FrozenModel):
    """Soft actor-critic on many worlds: every world makes a step, then there are several large updates."""

    num_worlds: int = Field(64, ge=1, description="worlds stepped together")
    gradient_steps: int = Field(
        8, ge=1, description="updates after a step of every world; 16 learn no more (docs/results)"
    )
    batch_size: int = Field(256, ge=1, description="transitions of an update")
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


class SkillsSACConfig(SACConfig):
    """Soft actor-critic of skill discovery. A class of its own, so that what is not given is as here, not as above."""

    gradient_steps: int = Field(
        4, ge=1, description="updates after a step of every world: 1 for 16 env steps; METRA: 1 for 4 to 32"
    )
    learning_rate: float = Field(3e-4, gt=0.0, description="of Adam")
    gamma: float = Field(0.98, gt=0.0, lt=1.0, description="discount of a step")
    tau: float = Field(0.005, gt=0.0, le=1.0, description="share by which target critics follow in an update")
    initial_entropy_coefficient: float = Field(0.01, gt=0.0, description="LSD's and METRA's code")
    target_entropy: float = Field(-0.5, description="for each action; METRA's code")
    critic_layer_norm: bool = Field(False, description="none has it")


class SkillsConfig(FrozenModel):
    """Skill discovery: a policy that a skill vector z steers, learned from an intrinsic reward alone."""

    method: str = Field(
        "lsd", description="lsd, diayn, dads, metra or csf, on the object's position alone; or FILE.py:CLASS of yours"
    )
    prior: Prior = Field("normal", description="of skills; that of its method")
    zero_shot: ZeroShot = Field("way", description="skill that leads to a goal; that of its method")
    size: int = Field(4, ge=1, description="of z; paper: 4, continuous")
    episode_steps: int = Field(50, ge=2, description="as downstream; CSD's Fetch tasks have as many")
    hidden_sizes: tuple[PositiveInt, ...] = Field(
        (256, 256), min_length=1, description="of the network that rewards come from; METRA's code has 1024 twice"
    )
    learning_rate: float = Field(3e-4, gt=0.0, description="of that network; LSD's code 3e-5, METRA's 1e-4, DADS' 3e-4")
    gradient_steps: int = Field(2, ge=1, description="of that network after a step of every world")
    batch_size: int = Field(256, ge=2, description="transitions of an update of that network")
    newest_steps: int = Field(
        1_000_000,
        ge=1,
        description="env steps that the network learns from: the newest of those kept; DADS' code has 10,000",
    )
    num_alternatives: int = Field(100, ge=1, description="DADS: skills that each one is compared with")
    dual_initial: float = Field(30.0, gt=0.0, description="METRA: first value of the dual variable")
    replay_steps: int = Field(1_000_000, ge=1, description="env steps that are kept to learn from")
    sac: SkillsSACConfig = SkillsSACConfig()

    @model_validator(mode="before")
    @classmethod
    def _as_its_method_has_them(cls, values: Any) -> Any:
        method = values.get("method", "lsd") if isinstance(values, Mapping) else None
        if not isinstance(method, str) or method not in SKILLS_OF:
            return values
        said = dict(zip(("prior", "zero_shot"), SKILLS_OF[method], strict=True))
        for key in said.keys() & values.keys():
            if values[key] != said[key]:
                raise ValueError(f"{key} of {method} is {said[key]}, not {values[key]!r}: leave it out")
        return {**values, **said}


class SkillDiscoveryConfig(Config):
    """Skill discovery: a policy that a skill vector steers, learned from an intrinsic reward alone."""

    made_in: ClassVar[str] = "service.methods.skills"
    makes: ClassVar[Literal["skills"]] = "skills"
    part: ClassVar[str] = "skills"

    method: Literal["skills"] = "skills"
    skills: SkillsConfig = SkillsConfig()

    def as_in(self, saved: Self) -> Self:
        """The same, with what a reward of a user's says of its skills."""
        if self.skills.method != saved.skills.method:
            return self
        said = {"prior": saved.skills.prior, "zero_shot": saved.skills.zero_shot}
        return self.model_copy(update={"skills": self.skills.model_copy(update=said)})

    @model_validator(mode="after")
    def _there_is_such_a_method(self) -> Self:
        method = self.skills.method
        if method not in SKILLS_OF and parse_reference(method) is None:
            raise ValueError(f"skills.method {method!r}: choose one of {', '.join(SKILLS_OF)}, or FILE.py:CLASS")
        return self

    @model_validator(mode="after")
    def _they_see_the_papers_positions(self) -> Self:
        if self.world.observed != ObservedConfig():
            raise ValueError("skill discovery sees the positions of the paper only: leave out world.observed")
        if self.world.num_objects > 1:
            raise ValueError("skill discovery moves one object: leave out world.objects")
        return self
