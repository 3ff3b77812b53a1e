"""Configuration of learning a task with frozen primitives or skills, or from nothing."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar, Literal, Self

from pydantic import Field, model_validator

from service.base.errors import ConfigError
from service.base.user_code import parse_reference
from service.config.run import SUCCESS_DISTANCE_M, Config, RunConfig
from service.config.skills import SACConfig


class TaskRunConfig(RunConfig):
    """Length and bookkeeping of learning a task. A class of its own, so that what is not given is as here."""

    total_env_steps: int = Field(300_000, ge=1)
    checkpoint_interval: int = Field(40, ge=1, description="iterations, each an episode of every world")
    keep_checkpoints: int = Field(1, ge=1, description="each has the whole replay buffer")
    evaluation_interval: int = Field(4, ge=0, description="iterations between two evaluations; 0: never")


class TaskConfig(Config):
    """Learning one task by one method of the table."""

    made_in: ClassVar[str] = "service.methods.task"
    makes: ClassVar[Literal["orchestrator"]] = "orchestrator"
    resumable: ClassVar[tuple[str, ...]] = ("run.", "primitives=")  # which may have moved: their digest is checked

    method: str
    task: str = Field(description="a name of ``tandem tasks``, or FILE.py, FILE.py:NAME or MODULE:NAME, one of yours")
    primitives: str = Field(
        "panda-cube@champion",
        description="version, run or export whose primitives or skills the method takes, and in whose world it plays",
    )
    primitives_digest: str | None = Field(None, description="of their parameters; a new run records it")
    sac: SACConfig = SACConfig()
    reward_margin_m: float = Field(
        0.01,
        ge=0.0,
        lt=SUCCESS_DISTANCE_M,
        description="while learning the object has to be this much nearer than what counts: it seldom leaves again",
    )
    task_version: int = Field(0, ge=0, description="of the task's Gymnasium name; a new run records it")
    episode_steps: int = Field(50, ge=1, description="of the task; a new run records it")
    task_world: dict[str, Any] | None = Field(
        None, description="settings of the world of a task of yours, with what its files say; a new run records them"
    )
    run: TaskRunConfig = TaskRunConfig()

    @property
    def directory_name(self) -> str:
        """Usual name of the run's directory: seeds of a method lie side by side."""
        return f"{self.name}-{self.seed}"

    def as_in(self, saved: Self) -> Self:
        """The same, with the exact version of the primitives and their world, where these may be those of ``saved``."""
        keys = ("primitives_digest", "task_version", "episode_steps", "task_world", "code")
        exact = {key: getattr(saved, key) for key in keys}
        update: dict[str, Any] = {key: value for key, value in exact.items() if key not in self.model_fields_set}
        if "world" not in self.model_fields_set:
            update["world"] = saved.world
        if _may_be(self.primitives, saved.primitives):
            update["primitives"] = saved.primitives
        elif saved.primitives_digest is not None and Path(self.primitives).exists():
            update["primitives"] = str(Path(self.primitives).absolute())
        else:
            raise ConfigError(
                f"primitives = {self.primitives!r}, but the run has {saved.primitives!r}; a resumed run keeps its "
                "configuration: leave it out, or name the path to which they moved"
            )
        return self.model_copy(update=update)

    @model_validator(mode="before")
    @classmethod
    def _has_a_name(cls, values: Any) -> Any:
        if not isinstance(values, Mapping):
            return values
        # runs that earlier commits of 0.3 began say that a skill is held for one step
        values = {key: value for key, value in values.items() if (key, value) != ("skill_steps", 1)}
        if "name" in values:
            return values
        file = Path(str(values.get("task"))).name.lower()  # without its directory and its ending
        task = re.sub(r"(\.py)?[^a-z0-9._]+|\.py$", "-", file).strip("-._")[:30]
        return {**values, "name": f"{task or 'task'}-{values.get('method')}"}

    @model_validator(mode="after")
    def _learns_something(self) -> Self:
        starts, episodes = self.sac.learning_starts, self.episode_steps * self.sac.num_worlds
        if self.run.total_env_steps <= starts:
            raise ValueError(
                f"run.total_env_steps = {self.run.total_env_steps} has to be more than sac.learning_starts, {starts}: "
                "so many env steps have random actions, and nothing is learned"
            )
        length_known = parse_reference(self.task) is None or bool(self.code)
        if self.method.endswith("-her") and length_known and starts < episodes:
            raise ValueError(
                f"sac.learning_starts = {starts}: goals are relabelled from whole episodes, so give at least "
                f"{episodes}, one of each of {self.sac.num_worlds} worlds"
            )
        return self


def _may_be(reference: str, exact: str) -> bool:
    """Whether a reference may have named this version or path when it was made exact; an alias may have moved on."""
    name, _, version = reference.partition("@")
    is_alias = name == exact.partition("@")[0] and not version.isdecimal()
    return is_alias or exact in (reference, str(Path(reference).absolute()))
