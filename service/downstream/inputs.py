"""Inputs of downstream learners: how things are and move, the goal, and the way to it."""

from __future__ import annotations

import numpy as np

from service.envs.observations import GOAL_FROM_OBJECT, PAPER, POSITIONS, Layouts
from service.policies.parameters import INPUT_CLIP
from service.sac.inputs import NUM_MOTION_INPUTS, motion_inputs
from service.types import FloatArray

_GOAL = PAPER.bob["goal"]
_GOAL_OFFSET, _GOAL_SCALE = PAPER.bob.normalisation.offset[_GOAL], PAPER.bob.normalisation.scale[_GOAL]


def num_inputs(seen: Layouts) -> tuple[int, int]:
    """Numbers of ``motion_inputs`` alone, and of ``learner_inputs``: 17 and 23 in the paper's worlds."""
    motion = NUM_MOTION_INPUTS + seen.positions.size - POSITIONS.size
    return motion, motion + seen.bob.size - seen.positions.size + GOAL_FROM_OBJECT.size


def learner_inputs(previous: FloatArray, positions: FloatArray, goal: FloatArray, seen: Layouts = PAPER) -> FloatArray:
    """(N, I) inputs of every downstream learner: those of ``motion_inputs``, the goal, and the way from the object.

    Args:
        previous: (N, P) positions one step ago; at an episode's start those of now.
        positions: (N, P), metres.
        goal: (N, 3), metres.
        seen: layouts of the world.
    """
    place = (goal - _GOAL_OFFSET) / _GOAL_SCALE
    relative = (goal - positions[:, POSITIONS["object"]]) / GOAL_FROM_OBJECT.normalisation.scale
    told = np.clip(np.concatenate((place, relative), axis=1), -INPUT_CLIP, INPUT_CLIP)
    motion = motion_inputs(previous, positions, seen.positions)
    inputs: FloatArray = np.concatenate((motion, told), axis=1, dtype=np.float32)
    return inputs
