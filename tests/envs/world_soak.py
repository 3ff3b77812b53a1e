"""Rough random steps, and the worst values that they lead to: does anything in the world break?"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from service.config import WorldConfig
from service.envs.batch import DISPLACEMENT_M, WorldBatch
from service.envs.panda import FINGER_STROKE_M, JOINT_LOWER, JOINT_UPPER
from service.envs.scene import TABLE_CENTER_X_M, TABLE_HALF_SIZE_M

GAME_STEPS = 100
HELD_STEPS = 20
JOINT_TOLERANCE_RAD = 1e-3
FINGER_TOLERANCE_M = 8e-3
"""A stop is a soft constraint: the arm's full momentum on one finger's outside bends it by millimetres for a step."""
TABLE_TOLERANCE_M = 12.5e-3
"""A quarter of the object: dropped from 0.7 m it dips in by 1 cm for one step."""

FloatArray = NDArray[np.float32]


@dataclass
class Extremes:
    """The worst values seen; every excess is positive outside its range."""

    num_steps: int = 0
    num_broken: int = 0
    num_fallen: int = 0
    contact_share: float = 0.0
    joint_excess_rad: float = -np.inf
    finger_excess_m: float = -np.inf
    sunk_m: float = -np.inf
    """Greatest depth of an object's centre below its resting height while over the table."""

    def within_bounds(self) -> bool:
        """No world diverged, no joint or finger past its limit, no object through the table."""
        return (
            self.num_broken == 0
            and self.joint_excess_rad <= JOINT_TOLERANCE_RAD
            and self.finger_excess_m <= FINGER_TOLERANCE_M
            and self.sunk_m <= TABLE_TOLERANCE_M
        )


def soak(config: WorldConfig, *, num_worlds: int, num_steps: int, seed: int, num_threads: int = 0) -> Extremes:
    """Step ``num_worlds`` worlds ``num_steps`` times each.

    A third of the worlds acts at random, a third holds full actions for 20 steps, a third steers at the object with
    noise and squeezes it. Every 100 steps all worlds start again; a world whose object fell starts again at once.
    """
    rng = np.random.default_rng(seed)
    extremes = Extremes(num_steps=num_worlds * num_steps)
    held = np.zeros((num_worlds, 4), dtype=np.float32)
    num_contacts = 0
    with WorldBatch(config, num_worlds, num_threads=num_threads) as worlds:
        for step in range(num_steps):
            if step % GAME_STEPS == 0:
                worlds.reset(rng)
            if step % HELD_STEPS == 0:
                held = np.sign(rng.uniform(-1.0, 1.0, held.shape)).astype(np.float32)
            extremes.num_broken += int(worlds.step(_actions(worlds, held, rng)).sum())
            num_contacts += int(worlds.contacts().any(axis=1).sum())
            _note(extremes, worlds)
            fallen = worlds.object_position[:, 2] < -config.object_size_m
            if fallen.any():
                extremes.num_fallen += int(fallen.sum())
                worlds.reset(rng, fallen)
    extremes.contact_share = num_contacts / extremes.num_steps
    return extremes


def _actions(worlds: WorldBatch, held: FloatArray, rng: np.random.Generator) -> FloatArray:
    actions = rng.uniform(-1.0, 1.0, held.shape).astype(np.float32)
    style = np.arange(worlds.num_worlds) % 3
    actions[style == 1] = held[style == 1]
    steered = style == 2
    towards = (worlds.object_position - worlds.ee_position)[steered] / DISPLACEMENT_M
    actions[steered, :3] += np.clip(towards, -2.0, 2.0).astype(np.float32)
    actions[steered, 3] = held[steered, 3]
    return actions


def _note(extremes: Extremes, worlds: WorldBatch) -> None:
    assert np.isfinite(worlds.states).all()
    joints, fingers = worlds.joints, worlds.positions()[:, 3:5]
    joint_excess = max((joints - JOINT_UPPER).max(), (JOINT_LOWER - joints).max())
    extremes.joint_excess_rad = max(extremes.joint_excess_rad, float(joint_excess))
    finger_excess = max(fingers.max() - FINGER_STROKE_M, -fingers.min())
    extremes.finger_excess_m = max(extremes.finger_excess_m, float(finger_excess))
    position = worlds.object_position
    over_table = np.abs(position[:, 0] - TABLE_CENTER_X_M) <= TABLE_HALF_SIZE_M[0]
    over_table &= np.abs(position[:, 1]) <= TABLE_HALF_SIZE_M[1]
    sunk = worlds.config.object_size_m / 2 - position[over_table, 2]
    extremes.sunk_m = max(extremes.sunk_m, float(sunk.max(initial=-np.inf)))
