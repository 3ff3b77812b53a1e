"""Inputs of downstream learners: how things are and move, the goal, and the way to it."""

from __future__ import annotations

import numpy as np

from service.envs.observations import BOB, GOAL_FROM_OBJECT, POSITIONS
from service.policies.parameters import INPUT_CLIP
from service.sac.inputs import NUM_MOTION_INPUTS, motion_inputs
from service.types import FloatArray

NUM_INPUTS = NUM_MOTION_INPUTS + BOB.size - POSITIONS.size + GOAL_FROM_OBJECT.size
"""Those of ``motion_inputs``, then the goal 3 and the goal relative to the object 3: 23."""
_GOAL = BOB["goal"]


def learner_inputs(previous: FloatArray, positions: FloatArray, goal: FloatArray) -> FloatArray:
    """(N, 23) inputs of every downstream learner.

    Args:
        previous: (N, 11) positions one step ago; at an episode's start those of now.
        positions: (N, 11), metres.
        goal: (N, 3), metres.
    """
    place = (goal - BOB.normalisation.offset[_GOAL]) / BOB.normalisation.scale[_GOAL]
    relative = (goal - positions[:, POSITIONS["object"]]) / GOAL_FROM_OBJECT.normalisation.scale
    told = np.clip(np.concatenate((place, relative), axis=1), -INPUT_CLIP, INPUT_CLIP)
    inputs: FloatArray = np.concatenate((motion_inputs(previous, positions), told), axis=1, dtype=np.float32)
    return inputs
