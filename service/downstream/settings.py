"""Settings of a trial: a method on a task with a seed, how it learns, and how it is evaluated."""

from __future__ import annotations

from typing import Any, TypeVar

from pydantic import Field, ValidationError

from service.config_tree import check_numbers
from service.downstream.methods import find_method
from service.envs.tasks import EPISODE_STEPS, SUCCESS_DISTANCE_M, find_task
from service.errors import TandemError
from service.frozen import FrozenModel
from service.off_policy_config import SACConfig

_Settings = TypeVar("_Settings", bound=FrozenModel)


class TrialConfig(FrozenModel):
    """One run of a method on a task."""

    task: str
    method: str
    seed: int = Field(0, ge=0, le=2**32 - 1)
    num_env_steps: int = Field(300_000, ge=1, description="of learning; 0 in the result of a method that does not")
    sac: SACConfig = SACConfig()
    curve_every: int = Field(4, ge=1, description="iterations between evaluations on the way; one is 50 steps a world")
    curve_episodes: int = Field(100, ge=1)
    skill_steps: int = Field(
        5,
        ge=1,
        le=EPISODE_STEPS,
        description="env steps that a skill is held; methods with primitives act anew in each",
    )
    reward_margin_m: float = Field(
        0.01,
        ge=0.0,
        lt=SUCCESS_DISTANCE_M,
        description="while learning the object has to be this much nearer than what counts: it seldom leaves again",
    )
    num_episodes: int = Field(300, ge=1, description="of the final evaluation; paper: 16, likely")
    task_version: int = Field(0, ge=0, description="of the task's Gymnasium name; what does not say it is of v0")

    @property
    def name(self) -> str:
        """Name of its files."""
        return f"{self.task}-{self.method}-{self.seed}"


def make_trial(**values: Any) -> TrialConfig:
    """Make a trial, checked.

    Raises:
        TandemError: an unknown task or method, a value out of its range, or too few env steps to learn anything.
    """
    task, method = find_task(values.get("task", "")), find_method(values.get("method", ""))
    trial = validate(TrialConfig, {**values, "task_version": task.version})
    sac = trial.sac
    if method.player is None and trial.num_env_steps <= sac.learning_starts:
        raise TandemError(
            f"{trial.num_env_steps} env steps are all uniform actions: give more than learning_starts, "
            f"{sac.learning_starts}"
        )
    episodes = EPISODE_STEPS * sac.num_worlds
    if method.her_ratio is not None and sac.learning_starts < episodes:
        raise TandemError(
            f"learning_starts = {sac.learning_starts}: goals are relabelled from whole episodes, so give at least "
            f"{episodes}, one of each of {sac.num_worlds} worlds"
        )
    return trial


def validate(kind: type[_Settings], values: Any) -> _Settings:
    """Settings from plain values.

    Raises:
        TandemError: the first thing that is wrong, as ``key = value: why``.
    """
    try:
        read = kind.model_validate(values)
        check_numbers(values, read.model_dump(), where="settings")
        return read
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        raise TandemError(f"{where} = {first['input']!r}: {first['msg'][:1].lower()}{first['msg'][1:]}") from None


def differences(recorded: dict[str, Any], wanted: dict[str, Any], prefix: str = "") -> list[str]:
    """``key: recorded, not wanted`` for each key in which two trees of settings differ."""
    found = []
    for key in sorted(recorded.keys() | wanted.keys()):
        old, new = recorded.get(key), wanted.get(key)
        if isinstance(old, dict) and isinstance(new, dict):
            found += differences(old, new, f"{prefix}{key}.")
        elif old != new:
            found.append(f"{prefix}{key} {old!r}, not {new!r}")
    return found
