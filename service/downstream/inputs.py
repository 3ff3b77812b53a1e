"""What downstream learners see: positions, the goal, the way to it, and how far things moved in the last step."""

from __future__ import annotations

import numpy as np

from service.envs.observations import BOB, GOAL_FROM_OBJECT, POSITIONS, bob_observation
from service.policies.parameters import INPUT_CLIP
from service.types import FloatArray

STEP_SCALE_M = 0.02
"""Scale of movements in a step, as inputs: the hand's full speed is two to three times as much."""
_MOVED = [*range(*POSITIONS["effector"].indices(POSITIONS.size)), *range(*POSITIONS["object"].indices(POSITIONS.size))]
NUM_WITHOUT_GOAL = POSITIONS.size + len(_MOVED)
"""The first inputs: positions 11, movements of end effector 3 and object 3."""
NUM_INPUTS = NUM_WITHOUT_GOAL + BOB.size - POSITIONS.size + GOAL_FROM_OBJECT.size
"""Those, then the goal 3 and the goal relative to the object 3: 23."""


def learner_inputs(previous: FloatArray, positions: FloatArray, goal: FloatArray) -> FloatArray:
    """(N, 23) inputs of every downstream learner, all about 1: metres are too small for a new network.

    Positions at one moment do not say how fast the arm and the object move: the arm lags behind its commands, and what
    was pushed slides on. Two moments do, and a real robot has them; no velocity is measured.

    Args:
        previous: (N, 11) positions one step ago; at an episode's start those of now.
        positions: (N, 11), metres.
        goal: (N, 3), metres.
    """
    rows = bob_observation(positions, goal)
    seen = (rows - BOB.normalisation.offset) / BOB.normalisation.scale
    moved = (positions[:, _MOVED] - previous[:, _MOVED]) / np.float32(STEP_SCALE_M)
    relative = (rows[:, BOB["goal"]] - rows[:, BOB["object"]]) / GOAL_FROM_OBJECT.normalisation.scale
    inputs = np.concatenate((seen[:, : POSITIONS.size], moved, seen[:, POSITIONS.size :], relative), axis=1)
    clipped: FloatArray = np.clip(inputs, -INPUT_CLIP, INPUT_CLIP, out=inputs)
    return clipped
