"""The methods of the paper's table, by name. The harness knows nothing of a method but what is here.

A method that learns says what its learner acts by (``wrap`` and ``decode``), which actor and replay buffer it has; one
with nothing to learn says which policy plays. A skill-discovery baseline would be one more entry: its ``wrap`` hands
the environment the actions of its frozen skill policy, with skill vectors as actions.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np

from service.actors.evaluation import DeterministicPolicy, IdlePolicy
from service.downstream.compose import (
    ComposePrimitivesVector,
    action_weights,
    check_primitives,
    check_robot,
    parameters_digest,
)
from service.errors import TandemError
from service.primitives.loading import TrainedBob
from service.types import FloatArray

Worlds = gymnasium.vector.VectorEnv[Any, Any, Any]


def _compose(trained: TrainedBob, positions: FloatArray, actions: FloatArray) -> FloatArray:
    mean, _ = trained.primitives.compose(positions, action_weights(actions))
    return np.clip(mean, -1.0, 1.0)


def _bob(trained: TrainedBob) -> DeterministicPolicy:
    return trained.policy


@dataclass(frozen=True, slots=True)
class Method:
    """One row of the table."""

    title: str
    """Name in the table."""
    description: str
    """A few words for ``tandem downstream methods``."""
    wrap: Callable[[Worlds, TrainedBob], Worlds] = lambda env, trained: env
    """The worlds its learner acts in."""
    decode: Callable[[TrainedBob, FloatArray, FloatArray], FloatArray] = lambda trained, positions, actions: actions
    """Turns (N, 11) positions and the learner's (N, A) actions into (N, 4) actions, as the wrapped worlds do."""
    mcp_actor: bool = False
    """Whether the actor is a Multiplicative Compositional Policy, learned end to end; else SAC's own network."""
    her_ratio: tuple[float, float] | None = None
    """Share of a batch whose goals are relabelled (HER, ``future``), when learning begins and when it ends, linear in
    between; None: no HER."""
    composes: bool = False
    """Whether it needs primitives that can be composed."""
    player: Callable[[TrainedBob], DeterministicPolicy] | None = None
    """Makes the policy that plays, where nothing is learned."""

    @property
    def takes_primitives(self) -> bool:
        """Whether its result depends on them; else they only say in which world it plays."""
        return self.composes or self.player is _bob

    def check(self, trained: TrainedBob) -> None:
        """Assert that these primitives are for this method.

        Raises:
            TandemError: primitives of another robot or layout, or none that can be composed.
        """
        check_robot(trained)
        if self.composes:
            check_primitives(trained)


_HER_SHARE = 0.8
"""1 - 1 / (k + 1) for the usual k = 4 (Andrychowicz et al. 2017)."""

METHODS: Mapping[str, Method] = {
    "ours": Method(
        "ours", "SAC sets the weights of the frozen primitives", ComposePrimitivesVector, _compose, composes=True
    ),
    "ours-her": Method(
        "ours + HER",
        "the same, with relabelled goals, fewer and fewer",
        ComposePrimitivesVector,
        _compose,
        composes=True,
        her_ratio=(_HER_SHARE, 0.0),
    ),
    "asp-only": Method("ASP only", "Bob as he is", player=_bob),
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
    "idle": Method("idle", "does nothing", player=lambda trained: IdlePolicy()),
}
"""The methods by the names that commands take, in the order of the table's rows."""


def find_method(name: str) -> Method:
    """Find a method by its name.

    Raises:
        TandemError: no such method.
    """
    if name not in METHODS:
        raise TandemError(f"unknown method {name!r}; choose one of {', '.join(METHODS)}")
    return METHODS[name]


def provenance(trained: TrainedBob, method: str = "ours") -> dict[str, Any]:
    """Primitives and world that a method's result is of, besides its trial.

    Returns:
        ``primitives``: their name, and SHA-256 of their parameters as ``digest``; None where the method takes none.
        ``world``: settings of the world that they bring along, before a task replaces some.
    """
    name = trained.label if trained.manifest is None else trained.manifest.reference  # the same wherever it came from
    primitives = {"name": name, "digest": parameters_digest(trained.policy)}
    without = method in METHODS and not METHODS[method].takes_primitives
    return {"primitives": None if without else primitives, "world": trained.config.world.model_dump(mode="json")}
