"""The methods of the paper's table, by name. Learning a task knows nothing of a method but what is here.

What a method takes, ``primitives``, ``skills`` or nothing, is loaded from elsewhere and never changes. Rows that learn
nothing are played by ``tandem evaluate --task``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from service.base.errors import TandemError, did_you_mean
from service.config.skills import SKILLS_OF


@dataclass(frozen=True, slots=True)
class TaskMethod:
    """One row of the table."""

    title: str
    """Name in the table."""
    description: str
    """A few words for ``tandem methods``."""
    takes: Literal["primitives", "skills"] | None = None
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
    adds_action: bool = False
    """Whether its learner adds an action of its own to the composition."""

    @property
    def composes(self) -> bool:
        """Whether its learner sets the weights of primitives."""
        return self.takes == "primitives" and self.learns


_HER_SHARE = 0.8
"""1 - 1 / (k + 1) for the usual k = 4 (Andrychowicz et al. 2017)."""


def _skill_method(name: str) -> TaskMethod:
    title = f"{name.upper()} skills"
    return TaskMethod(title, "SAC sets the skill vector", "skills", skills=name)


def _zero_shot_method(name: str) -> TaskMethod:
    return TaskMethod(f"{name.upper()}, zero-shot", "its skill towards the goal", "skills", learns=False, skills=name)


TASK_METHODS: Mapping[str, TaskMethod] = {
    "ours": TaskMethod("ours", "SAC sets the weights of the frozen primitives", "primitives"),
    "ours-her": TaskMethod(
        "ours + HER",
        "SAC sets the weights of the frozen primitives, with hindsight that fades out",
        "primitives",
        her_ratio=(_HER_SHARE, 0.0),
    ),
    "ours-residual-her": TaskMethod(
        "ours + residual + HER",
        "as ours-her, and adds a small action of its own",
        "primitives",
        her_ratio=(_HER_SHARE, 0.0),
        adds_action=True,
    ),
    "asp-only": TaskMethod("ASP only", "Bob as he is", "primitives", learns=False),
    "scratch-monolithic-her": TaskMethod(
        "scratch monolithic + HER", "SAC alone, with hindsight", her_ratio=(_HER_SHARE, _HER_SHARE)
    ),
    "scratch-mcp-her": TaskMethod(
        "scratch MCP + HER",
        "primitives and gate learned together by SAC, with hindsight",
        mcp_actor=True,
        her_ratio=(_HER_SHARE, _HER_SHARE),
    ),
    "scratch-monolithic": TaskMethod("scratch monolithic", "SAC alone"),
    "scratch-mcp": TaskMethod("scratch MCP", "primitives and gate learned together by SAC", mcp_actor=True),
    **{name: _skill_method(name) for name in SKILLS_OF},
    "any-skills": TaskMethod("skills", "SAC sets the skill vector of any skills", "skills"),
    **{f"{name}-zero-shot": _zero_shot_method(name) for name, (_, leads) in SKILLS_OF.items() if leads == "way"},
    "idle": TaskMethod("idle", "does nothing", learns=False),
}
"""The methods by the names that commands take, in the order of the table's rows."""


def find_method(name: str) -> TaskMethod:
    """Find a method by its name.

    Raises:
        TandemError: no such method.
    """
    if name not in TASK_METHODS:
        known = ", ".join(TASK_METHODS)
        raise TandemError(f"unknown method {name!r}; choose one of {known}{did_you_mean(name, TASK_METHODS)}")
    return TASK_METHODS[name]
