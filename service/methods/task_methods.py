"""The methods of the paper's table, by name. Learning a task knows nothing of a method but what is here.

A method says in which worlds its learner acts (``enter``), which actor it has and whether goals are relabelled. What
it takes, ``primitives``, ``skills`` or nothing, is loaded from elsewhere and never changes. Rows that learn nothing are
played by ``tandem evaluate --task``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import gymnasium

from service.base.errors import TandemError, did_you_mean
from service.envs.observations import layouts
from service.methods.compose import ComposePrimitivesVector, check_primitives, check_robot
from service.methods.task_worlds import SkillTaskWorlds, TaskWorlds
from service.registry.learned import RESIDUAL
from service.registry.loading import Kind, Trained

VectorEnv = gymnasium.vector.VectorEnv[Any, Any, Any]


@dataclass(frozen=True, slots=True)
class TaskMethod:
    """One row of the table."""

    title: str
    """Name in the table."""
    description: str
    """A few words for ``tandem methods``."""
    takes: Kind | None = None
    """What its result depends on; None: nothing, what is loaded only says in which world it plays."""
    mcp_actor: bool = False
    """Whether the actor is a Multiplicative Compositional Policy, learned end to end; else SAC's own network."""
    her_ratio: tuple[float, float] | None = None
    """Share of a batch whose goals are relabelled (HER, ``future``), when learning begins and in its second half,
    linear in between; None: no HER."""
    learns: bool = True
    """Or else it plays what it takes as it is."""
    skills: str | None = None
    """The skill-discovery method whose skills it takes."""
    residual: float = 0.0
    """Size of the greatest action that its learner adds to the composition."""

    @property
    def composes(self) -> bool:
        """Whether its learner sets the weights of primitives."""
        return self.takes == "primitives" and self.learns

    def enter(self, env: VectorEnv, seed: int, trained: Trained, hold_steps: int) -> TaskWorlds:
        """Make the worlds its learner acts in.

        Args:
            env: the task's.
            seed: of episodes.
            trained: what it takes.
            hold_steps: env steps that a skill is held.
        """
        if self.takes == "skills":
            return SkillTaskWorlds(env, seed, trained.skills, hold_steps)
        if self.composes:
            env = ComposePrimitivesVector(env, trained, residual=self.residual)
        return TaskWorlds(env, seed, layouts(trained.config.world))

    def check(self, trained: Trained) -> None:
        """Assert that these primitives or skills are for this method.

        Raises:
            TandemError: of another kind, robot or layout, skills of another method, or primitives that cannot be
                composed.
        """
        if self.takes == "skills" and trained.kind != "skills":
            name = self.skills or "lsd"
            raise TandemError(
                f"the method {self.title} needs skills, and {trained.label} has none: name some by --primitives, such "
                f"as panda-cube-{name}@latest, which tandem train --method {name} makes"
            )
        if self.takes is not None:
            trained.expect(self.takes, by=f"the method {self.title}")
        check_robot(trained)
        if self.composes:
            check_primitives(trained)
        if self.skills is not None and (found := trained.skills.method) != self.skills:
            raise TandemError(f"{trained.label} holds skills of {found}, this method takes those of {self.skills}")


_HER_SHARE = 0.8
"""1 - 1 / (k + 1) for the usual k = 4 (Andrychowicz et al. 2017)."""


def _skill_method(name: str) -> TaskMethod:
    title = f"{name.upper()} skills"
    return TaskMethod(title, "SAC sets the skill vector", "skills", skills=name)


def _zero_shot_method(name: str) -> TaskMethod:
    return TaskMethod(f"{name.upper()}, zero-shot", "its skill towards the goal", "skills", learns=False, skills=name)


METHODS: Mapping[str, TaskMethod] = {
    "ours": TaskMethod("ours", "SAC sets the weights of the frozen primitives", "primitives"),
    "ours-her": TaskMethod(
        "ours + HER", "the same, with relabelled goals, fewer and fewer", "primitives", her_ratio=(_HER_SHARE, 0.0)
    ),
    "ours-residual-her": TaskMethod(
        "ours + residual + HER",
        "and adds a small action of its own",
        "primitives",
        her_ratio=(_HER_SHARE, 0.0),
        residual=RESIDUAL,
    ),
    "asp-only": TaskMethod("ASP only", "Bob as he is", "primitives", learns=False),
    "scratch-monolithic-her": TaskMethod(
        "scratch monolithic + HER", "SAC alone, with relabelled goals", her_ratio=(_HER_SHARE, _HER_SHARE)
    ),
    "scratch-mcp-her": TaskMethod(
        "scratch MCP + HER",
        "primitives and gate learned together, with relabelled goals",
        mcp_actor=True,
        her_ratio=(_HER_SHARE, _HER_SHARE),
    ),
    "scratch-monolithic": TaskMethod("scratch monolithic", "SAC alone"),
    "scratch-mcp": TaskMethod("scratch MCP", "primitives and gate learned together by SAC", mcp_actor=True),
    "lsd": _skill_method("lsd"),
    "dads": _skill_method("dads"),
    "diayn": _skill_method("diayn"),
    "metra": _skill_method("metra"),
    "csf": _skill_method("csf"),
    "any-skills": TaskMethod("skills", "SAC sets the skill vector, whoever's they are", "skills"),
    "lsd-zero-shot": _zero_shot_method("lsd"),
    "metra-zero-shot": _zero_shot_method("metra"),
    "csf-zero-shot": _zero_shot_method("csf"),
    "idle": TaskMethod("idle", "does nothing", learns=False),
}
"""The methods by the names that commands take, in the order of the table's rows."""


def find_method(name: str) -> TaskMethod:
    """Find a method by its name.

    Raises:
        TandemError: no such method.
    """
    if name not in METHODS:
        raise TandemError(f"unknown method {name!r}; choose one of {', '.join(METHODS)}{did_you_mean(name, METHODS)}")
    return METHODS[name]
