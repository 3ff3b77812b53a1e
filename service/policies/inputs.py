"""Inputs of actors and critics that say how things move: positions at two moments."""

from __future__ import annotations

import numpy as np

from service.base.types import FloatArray
from service.envs.observations import POSITIONS, ObservationLayout
from service.policies.forward import INPUT_CLIP

STEP_SCALE_M = 0.02
"""Scale of movements in a step, as inputs: the hand's full speed is two to three times as much."""
_MOVED = [*range(*POSITIONS["effector"].indices(POSITIONS.size)), *range(*POSITIONS["object"].indices(POSITIONS.size))]
NUM_MOTION_INPUTS = POSITIONS.size + len(_MOVED)
"""Positions 11, movements of end effector 3 and object 3: 17; where more is observed, that comes besides."""


def motion_inputs(previous: FloatArray, positions: FloatArray, layout: ObservationLayout = POSITIONS) -> FloatArray:
    """(N, P + 6) inputs, all about 1: metres are too small for a new network.

    Positions at one moment do not say how fast the arm and the object move: the arm lags behind its commands, and what
    was pushed slides on. Two moments do, and a real robot has them; no velocity is measured.

    Args:
        previous: (N, P) positions one step ago; at an episode's start those of now.
        positions: (N, P), metres.
        layout: of positions.
    """
    seen = (positions - layout.normalisation.offset) / layout.normalisation.scale
    moved = (positions[:, _MOVED] - previous[:, _MOVED]) / np.float32(STEP_SCALE_M)
    inputs: FloatArray = np.concatenate((seen, moved), axis=1)
    return np.clip(inputs, -INPUT_CLIP, INPUT_CLIP, out=inputs)
