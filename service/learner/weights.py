"""The parameters that actors get. They unpickle them without torch, so nothing here may import it."""

from __future__ import annotations

from dataclasses import dataclass

from service.types import FloatArray


@dataclass(frozen=True, slots=True)
class Weights:
    """Parameters of both players, of one policy version."""

    version: int
    alice: dict[str, FloatArray]
    bob: dict[str, FloatArray]
    bob_ema: dict[str, FloatArray]
    """Moving average of Bob's parameters, to be evaluated and published; see ``learner.bob_ema_decay``."""
