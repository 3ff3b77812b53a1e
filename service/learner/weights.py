"""What the learner gives out. Whoever plays with it unpickles it, so nothing here may import torch."""

from __future__ import annotations

from dataclasses import dataclass

from service.policies.parameters import FloatArray


@dataclass(frozen=True, slots=True)
class Weights:
    """What actors need to play with one policy version."""

    version: int
    alice: dict[str, FloatArray]
    bob: dict[str, FloatArray]
    steady_bob: dict[str, FloatArray]
    """Bob without the sway of single updates, to be evaluated and published; see ``learner.bob_average_decay``."""
