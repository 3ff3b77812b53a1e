"""What every run has, whatever it trains: a name, a seed, a world, a method and a length."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from pathlib import Path
from typing import Any, ClassVar, Literal, Self

from pydantic import Field

from service.base.parsing import NAME
from service.config.frozen import FrozenModel
from service.config.world import WorldConfig

CELL_SIZE_M = 0.05
"""Usual edge of a goal cell."""
SUCCESS_DISTANCE_M = 0.05
"""Greatest distance from object to goal that counts as success (paper: 5 cm)."""


class RunConfig(FrozenModel):
    """Length and bookkeeping of a run."""

    total_env_steps: int = Field(3_000_000, ge=1, description="of self-play: both players' steps together")
    checkpoint_interval: int = Field(20, ge=1, description="iterations between two checkpoints")
    keep_checkpoints: int = Field(3, ge=1, description="the newest, which are kept")
    evaluation_interval: int = Field(20, ge=0, description="iterations between two evaluations; 0: never")
    evaluation_episodes: int = Field(
        100, ge=1, description="of each evaluation on the way; skill discovery measures coverage"
    )
    final_episodes: int = Field(300, ge=1, description="of the evaluation at the end; paper: 16, likely")
    evaluation_steps: int = Field(
        50, ge=1, description="env steps of an episode of evaluation, 40 ms each; a task has its own"
    )
    num_threads: int = Field(
        0,
        ge=0,
        description="threads that step worlds, and of a task's torch; 0: a core each, and one for torch",
    )


class Config(FrozenModel):
    """The configuration of a run: the keys of all methods. The class of a method derives from it and adds its own."""

    name: str = Field("panda-cube", pattern=f"^{NAME}$", description="registry name of what it makes")
    seed: int = Field(0, ge=0, le=2**32 - 1, description="all random numbers follow from it")
    method: str = Field(
        description="a name of ``tandem methods``; or FILE.py, FILE.py:CLASS or MODULE:CLASS, a class of yours"
    )
    world: WorldConfig = WorldConfig()
    run: RunConfig = RunConfig()
    code: Mapping[str, str] = Field({}, description="texts of files of yours that it uses; a new run records them")

    made_in: ClassVar[str] = ""
    """The module whose ``make`` makes the method, and whose ``begin``, if any, completes the configuration."""
    runs_on_ray: ClassVar[bool] = False
    """Whether the method can have its workers on a Ray cluster."""
    makes: ClassVar[Literal["primitives", "skills", "orchestrator"] | None] = None
    """What is published at the end; None for nothing."""
    part: ClassVar[str] = "policy"
    """The component of the method's state that is published."""
    resumable: ClassVar[tuple[str, ...]] = ("run.",)
    """Beginnings of the keys that a resumed run may change, as none of them changes what is already done."""

    @property
    def directory_name(self) -> str:
        """Usual name of the run's directory."""
        return self.name

    @property
    def success_distance_m(self) -> float:
        """Greatest distance from object to goal that counts as success."""
        return SUCCESS_DISTANCE_M

    @property
    def publishable(self) -> bool:
        """Whether what this run makes can be published."""
        return self.makes is not None

    def begin(self, registry: Path | str, start_from: Any) -> Self:
        """The configuration as a new run records it, with what it takes from elsewhere said exactly.

        Args:
            registry: where versions are looked up.
            start_from: what ``--from`` names, as ``load`` gives it; None for nothing.

        Raises:
            TandemError: something that it needs is missing or does not fit.
        """
        begin = getattr(import_module(self.made_in), "begin", None) if self.made_in else None
        exact: Self = begin(self, registry, start_from) if begin is not None else self
        return exact

    def as_in(self, saved: Self) -> Self:
        """Return a copy with the exact values that ``begin`` recorded in a saved configuration."""
        return self

    def check_here(self) -> None:
        """Check that this machine has what the method needs.

        Raises:
            TandemError: it has not.
        """
        check = getattr(import_module(self.made_in), "check_here", None) if self.made_in else None
        if check is not None:
            check(self)

    def build(self, registry: Path | str, start_from: Any) -> Any:
        """Make the ``Method``; torch is imported no sooner. A class of yours makes its own.

        Args:
            registry: where versions are looked up.
            start_from: what a new run begins from; None for nothing, and for a run that is resumed.

        Raises:
            TandemError: something that it needs is missing or does not fit.
        """
        return import_module(self.made_in).make(self, registry, start_from)
