"""The methods of the paper's table, by name. The harness knows nothing of a method but what is here.

A method that learns says in which worlds its learner acts (``enter``), which actor it has and whether goals are
relabelled; one with nothing to learn says which policy plays. What a method takes, ``primitives``, ``skills`` or
nothing, comes from a registry and never changes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium

from service.actors.evaluation import DeterministicPolicy, IdlePolicy
from service.baselines.frozen import ZeroShotPolicy
from service.downstream.compose import ComposePrimitivesVector, check_primitives, check_robot
from service.downstream.skills import SkillTaskWorlds
from service.downstream.worlds import TaskWorlds
from service.envs.observations import layouts
from service.errors import TandemError, did_you_mean
from service.off_policy_config import SkillMethod
from service.policies.parameters import Parameters
from service.primitives.learned import RESIDUAL, Frozen, LearnedPolicy
from service.primitives.loading import Kind, Trained, load


def _enter(env: gymnasium.vector.VectorEnv[Any, Any, Any], seed: int, trained: Trained, hold_steps: int) -> TaskWorlds:
    return TaskWorlds(env, seed, layouts(trained.config.world))


def _enter_composing(
    env: gymnasium.vector.VectorEnv[Any, Any, Any],
    seed: int,
    trained: Trained,
    hold_steps: int,
    *,
    residual: float = 0.0,
) -> TaskWorlds:
    return _enter(ComposePrimitivesVector(env, trained, residual=residual), seed, trained, hold_steps)


def _enter_with_skills(
    env: gymnasium.vector.VectorEnv[Any, Any, Any], seed: int, trained: Trained, hold_steps: int
) -> TaskWorlds:
    return SkillTaskWorlds(env, seed, trained.skills, hold_steps)


def _idle(trained: Trained) -> DeterministicPolicy:
    return IdlePolicy()


def _bob(trained: Trained) -> DeterministicPolicy:
    return trained.policy


def _zero_shot(trained: Trained) -> DeterministicPolicy:
    return ZeroShotPolicy(trained.skills)


@dataclass(frozen=True, slots=True)
class Method:
    """One row of the table."""

    title: str
    """Name in the table."""
    description: str
    """A few words for ``tandem downstream methods``."""
    takes: Kind | None = None
    """What its result depends on; None: nothing, what is loaded only says in which world it plays."""
    enter: Callable[[gymnasium.vector.VectorEnv[Any, Any, Any], int, Trained, int], TaskWorlds] = _enter
    """Makes the worlds its learner acts in, of the task's, a seed, what it takes, and the env steps a skill is held."""
    mcp_actor: bool = False
    """Whether the actor is a Multiplicative Compositional Policy, learned end to end; else SAC's own network."""
    her_ratio: tuple[float, float] | None = None
    """Share of a batch whose goals are relabelled (HER, ``future``), when learning begins and in its second half,
    linear in between; None: no HER."""
    player: Callable[[Trained], DeterministicPolicy] | None = None
    """Makes the policy that plays, where nothing is learned."""
    skills: SkillMethod | None = None
    """The skill-discovery method whose skills it takes."""
    residual: float = 0.0
    """Size of the greatest action that its learner adds to the composition."""

    @property
    def composes(self) -> bool:
        """Whether its learner sets the weights of primitives."""
        return self.takes == "primitives" and self.player is None

    @property
    def holds(self) -> bool:
        """Whether its learner's action lasts for several env steps."""
        return self.takes == "skills" and self.player is None

    def frozen(self, trained: Trained) -> Frozen:
        """What its policy acts with; None: it acts by itself."""
        if self.takes is None:
            return None
        return trained.primitives if self.takes == "primitives" else trained.skills

    def learned(self, parameters: Parameters, trained: Trained, hold_steps: int = 1) -> LearnedPolicy:
        """The policy of what its learner has exported."""
        return LearnedPolicy(parameters, self.frozen(trained), layouts(trained.config.world), hold_steps)

    def check(self, trained: Trained) -> None:
        """Assert that these primitives or skills are for this method.

        Raises:
            TandemError: of another kind, robot or layout, skills of another method, or primitives that cannot be
                composed.
        """
        if self.takes is not None:
            trained.expect(self.takes, by=f"the method {self.title}")
        check_robot(trained)
        if self.composes:
            check_primitives(trained)
        if self.skills is not None and (found := trained.skills.method) != self.skills:
            raise TandemError(f"{trained.label} holds skills of {found}, this method takes those of {self.skills}")


_HER_SHARE = 0.8
"""1 - 1 / (k + 1) for the usual k = 4 (Andrychowicz et al. 2017)."""


def _composing_method(
    title: str, description: str, *, her_ratio: tuple[float, float] | None = None, residual: float = 0.0
) -> Method:
    return Method(
        title,
        description,
        "primitives",
        partial(_enter_composing, residual=residual),
        her_ratio=her_ratio,
        residual=residual,
    )


def _skill_method(name: SkillMethod) -> Method:
    title = f"{name.upper()} skills"
    return Method(title, "SAC sets the skill vector", "skills", _enter_with_skills, skills=name)


def _zero_shot_method(name: SkillMethod) -> Method:
    return Method(f"{name.upper()}, zero-shot", "its skill towards the goal", "skills", player=_zero_shot, skills=name)


METHODS: Mapping[str, Method] = {
    "ours": _composing_method("ours", "SAC sets the weights of the frozen primitives"),
    "ours-her": _composing_method(
        "ours + HER", "the same, with relabelled goals, fewer and fewer", her_ratio=(_HER_SHARE, 0.0)
    ),
    "ours-residual-her": _composing_method(
        "ours + residual + HER", "and adds a small action of its own", her_ratio=(_HER_SHARE, 0.0), residual=RESIDUAL
    ),
    "asp-only": Method("ASP only", "Bob as he is", "primitives", player=_bob),
    "scratch-monolithic-her": Method(
        "scratch monolithic + HER", "SAC alone, with relabelled goals", her_ratio=(_HER_SHARE, _HER_SHARE)
    ),
    "scratch-mcp-her": Method(
        "scratch MCP + HER",
        "primitives and gate learned together, with relabelled goals",
        mcp_actor=True,
        her_ratio=(_HER_SHARE, _HER_SHARE),
    ),
    "scratch-monolithic": Method("scratch monolithic", "SAC alone"),
    "scratch-mcp": Method("scratch MCP", "primitives and gate learned together by SAC", mcp_actor=True),
    "lsd": _skill_method("lsd"),
    "dads": _skill_method("dads"),
    "diayn": _skill_method("diayn"),
    "metra": _skill_method("metra"),
    "lsd-zero-shot": _zero_shot_method("lsd"),
    "metra-zero-shot": _zero_shot_method("metra"),
    "idle": Method("idle", "does nothing", player=_idle),
}
"""The methods by the names that commands take, in the order of the table's rows."""


def find_method(name: str) -> Method:
    """Find a method by its name.

    Raises:
        TandemError: no such method.
    """
    if name not in METHODS:
        raise TandemError(f"unknown method {name!r}; choose one of {', '.join(METHODS)}{did_you_mean(name, METHODS)}")
    return METHODS[name]


def load_for(methods: Iterable[str], reference: str, registry: Path | str) -> Trained:
    """Load what methods take: skills, or primitives; a method that takes neither plays in their world.

    Raises:
        TandemError: no such method, methods that take different kinds, or nothing of that kind there by that reference.
    """
    kinds: dict[Kind, str] = {takes: name for name in methods if (takes := find_method(name).takes)}
    if len(kinds) > 1:
        raise TandemError(
            f"{kinds['primitives']} takes primitives and {kinds['skills']} skills: run them by two commands, each with "
            "its own --primitives"
        )
    trained = load(reference, registry)
    for kind, name in kinds.items():
        trained.expect(kind, by=f"the method {name}")
    return trained


def provenance(trained: Trained, method: str = "ours") -> dict[str, Any]:
    """Primitives or skills and the world that a method's result is of, besides its trial.

    Returns:
        ``primitives``: their name, SHA-256 of their parameters as ``digest``, and the env steps that they took (None of
        a run directory); None where the method takes neither primitives nor skills.
        ``world``: settings of the world that they bring along, before a task replaces some.
    """
    name = trained.label if trained.manifest is None else trained.manifest.reference  # the same wherever it came from
    env_steps = None if trained.manifest is None else trained.manifest.metrics.get("env_steps")
    primitives = {"name": name, "digest": trained.digest, "env_steps": env_steps}
    without = method in METHODS and METHODS[method].takes is None
    return {"primitives": None if without else primitives, "world": trained.config.world.model_dump(mode="json")}
