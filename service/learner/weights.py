"""Parameters for actors, and how old they may be. Actors unpickle them without torch, so this may not import it."""

from __future__ import annotations

from dataclasses import dataclass

from service.base.types import FloatArray

MAX_POLICY_LAG = 2
"""Policy versions between the one that acted and the one that learns from it, at most; 1 where all are equally fast."""


@dataclass(frozen=True, slots=True)
class Weights:
    """Parameters of both players, of one policy version."""

    version: int
    alice: dict[str, FloatArray]
    bob: dict[str, FloatArray]
    bob_ema: dict[str, FloatArray]
    """Moving average of Bob's parameters, to be evaluated and published; see ``learner.bob_ema_decay``."""
