"""A hand-written pick-and-place for many worlds: what must be possible before anything can learn it."""

from dataclasses import dataclass

import numpy as np

from service.envs.batch import DISPLACEMENT_M, WorldBatch
from service.envs.sampling import sample_in_volume

OPEN, CLOSE = 1.0, -1.0
_GRASP_HEIGHT_M = 0.022
_LOWEST_GOAL_M = 0.08
_APPROACH_STEPS, _DESCENT_STEPS, _CLOSE_STEPS, _CARRY_STEPS = 12, 6, 3, 18
_HOLD_S = 5.0


@dataclass(frozen=True)
class Placement:
    """Outcome of N placements."""

    grasped: np.ndarray
    """(N,) both fingers touched the object after closing."""
    distance_m: np.ndarray
    """(N,) object to goal on arrival."""
    distance_after_hold_m: np.ndarray
    """(N,) the same after the hold."""
    slip_m: np.ndarray
    """(N,) how far the object moved relative to the end effector during the hold, at most."""


def drive(worlds, target, grip, num_steps):
    """Servo every end effector towards ``target()`` (N, 3), metres, with one finger command."""
    actions = np.full((worlds.num_worlds, 4), grip, dtype=np.float32)
    for _ in range(num_steps):
        actions[:, :3] = (target() - worlds.ee_position) / DISPLACEMENT_M
        yield worlds.step(actions)


def grasp(worlds):
    """From a fresh reset: above the object, down, close."""

    def above_object(height):
        return lambda: np.column_stack([worlds.object_position[:, :2], np.full(worlds.num_worlds, height)])

    travel = worlds.config.start_height_m
    for stage in (
        drive(worlds, above_object(travel), OPEN, _APPROACH_STEPS),
        drive(worlds, above_object(_GRASP_HEIGHT_M), OPEN, _DESCENT_STEPS),
        drive(worlds, above_object(_GRASP_HEIGHT_M), CLOSE, _CLOSE_STEPS),
    ):
        for _ in stage:
            pass


def place_in_air(config, num_worlds, *, seed, num_threads=2):
    """Pick the object up from a random place, carry it to a random point in the air, hold it there for 5 s."""
    rng = np.random.default_rng(seed)
    with WorldBatch(config, num_worlds, num_threads=num_threads) as worlds:
        worlds.reset(rng)
        goal = sample_in_volume(rng, num_worlds, config.workspace, lowest_m=_LOWEST_GOAL_M)
        grasp(worlds)
        grasped = worlds.contacts().all(axis=1)

        def carry():
            return goal + worlds.ee_position - worlds.object_position

        def distance():
            return np.linalg.norm(worlds.object_position - goal, axis=1)

        for _ in drive(worlds, carry, CLOSE, _CARRY_STEPS):
            pass
        arrived = distance()
        held = worlds.object_position - worlds.ee_position
        slip = np.zeros(num_worlds)
        for _ in drive(worlds, carry, CLOSE, round(_HOLD_S / config.step_s)):
            slip = np.maximum(slip, np.linalg.norm(worlds.object_position - worlds.ee_position - held, axis=1))
        return Placement(grasped, arrived, distance(), slip)
