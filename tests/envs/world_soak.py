"""Rough random steps, and the worst values that they lead to: does anything in the world break?"""

from dataclasses import dataclass

import numpy as np

from service.envs.batch import DISPLACEMENT_M, WorldBatch
from service.envs.panda import FINGER_STROKE_M, JOINT_LOWER, JOINT_UPPER
from service.envs.scene import TABLE_CENTER_X_M, TABLE_HALF_SIZE_M

HELD_STEPS = 20
JOINT_TOLERANCE_RAD = 1e-3
FINGER_TOLERANCE_M = 8e-3
"""A stop is a soft constraint: the arm's full momentum on one finger's outside bends it by millimetres for a step."""
TABLE_TOLERANCE_M = 12.5e-3
"""A quarter of the object: dropped from 0.7 m it dips in by 1 cm for one step."""


@dataclass
class Extremes:
    """The worst values seen; every excess is positive outside its range."""

    num_broken: int = 0
    contact_share: float = 0.0
    joint_excess_rad: float = -np.inf
    finger_excess_m: float = -np.inf
    sunk_m: float = -np.inf
    """Greatest depth of an object's centre below its resting height while over the table."""

    def within_bounds(self):
        """No world diverged, no joint or finger past its limit, no object through the table."""
        return (
            self.num_broken == 0
            and self.joint_excess_rad <= JOINT_TOLERANCE_RAD
            and self.finger_excess_m <= FINGER_TOLERANCE_M
            and self.sunk_m <= TABLE_TOLERANCE_M
        )


def soak(config, *, num_worlds, num_steps, seed):
    """Step ``num_worlds`` worlds ``num_steps`` times each.

    A third of the worlds acts at random, a third holds full actions for 20 steps, a third steers at the object with
    noise and squeezes it. A world whose object fell starts again at once.
    """
    rng = np.random.default_rng(seed)
    extremes, style = Extremes(), np.arange(num_worlds) % 3
    with WorldBatch(config, num_worlds) as worlds:
        worlds.reset(rng)
        for step in range(num_steps):
            if step % HELD_STEPS == 0:
                held = np.sign(rng.uniform(-1.0, 1.0, (num_worlds, 4))).astype(np.float32)
            actions = rng.uniform(-1.0, 1.0, held.shape).astype(np.float32)
            actions[style == 1] = held[style == 1]
            towards = (worlds.object_position - worlds.ee_position)[style == 2] / DISPLACEMENT_M
            actions[style == 2, :3] += np.clip(towards, -2.0, 2.0).astype(np.float32)
            actions[style == 2, 3] = held[style == 2, 3]
            extremes.num_broken += int(worlds.step(actions).sum())
            extremes.contact_share += worlds.contacts().any(axis=1).mean() / num_steps
            _note(extremes, worlds)
            fallen = worlds.object_position[:, 2] < -config.object_size_m
            if fallen.any():
                worlds.reset(rng, fallen)
    return extremes


def _note(extremes, worlds):
    assert np.isfinite(worlds.states).all()
    joints, fingers, position = worlds.joints, worlds.positions()[:, 3:5], worlds.object_position
    joint_excess = max((joints - JOINT_UPPER).max(), (JOINT_LOWER - joints).max())
    extremes.joint_excess_rad = max(extremes.joint_excess_rad, joint_excess)
    extremes.finger_excess_m = max(extremes.finger_excess_m, fingers.max() - FINGER_STROKE_M, -fingers.min())
    over_table = np.abs(position[:, 0] - TABLE_CENTER_X_M) <= TABLE_HALF_SIZE_M[0]
    over_table &= np.abs(position[:, 1]) <= TABLE_HALF_SIZE_M[1]
    sunk = worlds.config.object_size_m / 2 - position[over_table, 2]
    extremes.sunk_m = max(extremes.sunk_m, sunk.max(initial=-np.inf))
