"""What a bridge must know of a policy and is measured rather than read: response, motion, late observations.

A robot that follows the action's words instead, 5 cm a step, or sees the object later than the policy was trained to,
fails where the simulator does not. Everything here is played in the policy's own world. What is found is part of
``policy.json``.
"""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np

from service.actors.evaluation import REPORTED_SEED, DeterministicPolicy, evaluate
from service.base.types import BoolArray, FloatArray, StateArray
from service.config import WorldConfig
from service.envs.batch import DISPLACEMENT_M, WIDTH_CHANGE_M, WorldBatch
from service.envs.observations import COMMAND_PREFIX, DELAY, ObservationLayout, bob_observation, layouts
from service.registry.loading import Trained

Measured = dict[str, Any]
"""What was measured, by the keys of ``policy.json``."""
_NUM_PLACES = 64
_FROM_EDGE_M = 0.05
"""Distance of the places from the workspace's edge, so that no command is clipped."""
_ABOVE_OBJECT_M = 0.12
"""Of the lowest place; two full steps down end above every object."""
_MAX_LATE_STEPS = 2
_TOLERATED_LOSS = 0.1


def measure(trained: Trained, num_episodes: int) -> tuple[Measured, FloatArray]:
    """Measure a policy and its arm on random goals of its world; takes seconds.

    Returns:
        What was measured; and (T, E, O) observations of the episodes without delay, T steps and the start, E episodes.
    """
    observations: list[FloatArray] = []
    tip: list[StateArray] = []

    def record(worlds: WorldBatch, goal: StateArray, _: BoolArray) -> None:
        observations.append(bob_observation(worlds.positions(), goal))
        tip.append(worlds.ee_position.copy())

    layout = layouts(trained.world).bob
    late = []
    for steps in range(_MAX_LATE_STEPS + 1):
        found = evaluate(
            _Late(trained.player(), steps, layout),
            trained.world,
            trained.tried_on,
            num_episodes=num_episodes,
            num_steps=trained.num_steps,
            success_distance_m=trained.success_distance_m,
            seed=REPORTED_SEED,
            observe=record if steps == 0 else None,
        )
        late.append(
            {
                "steps": steps,
                "success_last": found.success_last,
                "success_last_low": found.success_last_low,  # ends of the 95 % Wilson interval
                "success_last_high": found.success_last_high,
            }
        )
    measured = {
        **measure_response(trained.world),
        "motion": _motion(np.stack(tip), trained.world),
        "late_observations": late,
    }
    return measured, np.stack(observations)


def tolerated_late_steps(measured: Measured) -> int:
    """Greatest delay, of those measured, up to which success is within 10 points of that without delay."""
    rates = [late["success_last"] for late in measured["late_observations"]]
    good = [rate >= rates[0] - _TOLERATED_LOSS for rate in rates]
    return good.index(False) - 1 if False in good else len(good) - 1


def measure_response(world: WorldConfig) -> Measured:
    """Measure how far the arm and the gripper come in the step of a full action, without anything in their way."""
    seen = world.observed.model_copy(update={"obstacles": False})
    empty = world.model_copy(update={"fixture": "none", "fixtures": (), "obstacles": (), "observed": seen})
    rng = np.random.default_rng(REPORTED_SEED)
    with WorldBatch(empty, _NUM_PLACES) as worlds:
        widest_m = worlds.robot.widest_m
        return {
            "response": [_axis_response(worlds, rng, axis, direction) for axis in range(3) for direction in (1, -1)],
            "width_response": [_width_response(worlds, rng, direction, widest_m) for direction in (1, -1)],
        }


class _Late:
    """A policy that sees positions of some steps ago, but knows its own commands, and the delay if it observes it."""

    def __init__(self, policy: DeterministicPolicy, num_steps: int, layout: ObservationLayout) -> None:
        self._policy, self._num_steps = policy, num_steps
        self._known = [part for name, part in layout.columns.items() if name.startswith(COMMAND_PREFIX)]
        self._delay = [part for name, part in layout.columns.items() if name == DELAY]
        self._seen: deque[FloatArray] = deque(maxlen=num_steps + 1)

    def act_deterministic(self, observation: FloatArray) -> FloatArray:
        self._seen.append(observation)
        late = self._seen[0].copy()
        for part in self._known:
            late[:, part] = observation[:, part]
        for part in self._delay:
            late[:, part] = self._num_steps
        return self._policy.act_deterministic(late)


def _place(worlds: WorldBatch, rng: np.random.Generator, width_m: float) -> None:
    """Put the arms to rest at random places over the table, the gripper open by ``width_m``."""
    workspace = worlds.config.workspace
    edge_m = min(_FROM_EDGE_M, workspace.length_x_m / 4, workspace.length_y_m / 4, workspace.height_m / 4)
    lower, upper = np.array(workspace.lower_m) + edge_m, np.array(workspace.upper_m) - edge_m
    lower[2] = min(2.0 * max(worlds.config.rest_heights_m) + _ABOVE_OBJECT_M, upper[2])
    places = worlds.reach.clip(rng.uniform(lower, upper, (worlds.num_worlds, 3)))
    worlds.reset(rng)
    states = worlds.states.copy()
    states[:, worlds.layout["joints"]] = worlds.robot.arm.solve(worlds.joints, places, num_iterations=30)
    states[:, worlds.layout["fingers"]] = worlds.robot.finger_values(np.full(worlds.num_worlds, width_m))
    worlds.restore(states)


def _full_action(worlds: WorldBatch, number: int, direction: int) -> FloatArray:
    actions = np.zeros((worlds.num_worlds, 4), dtype=np.float32)
    actions[:, number] = direction
    return actions


def _axis_response(worlds: WorldBatch, rng: np.random.Generator, axis: int, direction: int) -> Measured:
    """Share of a full action's way that is covered by the end of its step: in the first one from rest, and the next."""
    _place(worlds, rng, 0.0)
    shares = []
    for _ in range(2):
        before = worlds.ee_position.copy()
        worlds.step(_full_action(worlds, axis, direction))
        shares.append(direction * (worlds.ee_position - before)[:, axis] / DISPLACEMENT_M)
    rest, moving = shares
    return {
        "axis": "xyz"[axis],
        "direction": direction,
        "from_rest_mean": float(rest.mean()),
        "from_rest_std": float(rest.std()),
        "moving_mean": float(moving.mean()),
        "moving_std": float(moving.std()),
    }


def _width_response(worlds: WorldBatch, rng: np.random.Generator, direction: int, widest_m: float) -> Measured:
    """Way of the gripper in the step of a full action: opening (1) from closed, closing (-1) from open."""
    start_m = 0.0 if direction > 0 else widest_m
    _place(worlds, rng, start_m)
    worlds.step(_full_action(worlds, 3, direction))
    width_m = worlds.robot.openings(worlds.states[:, worlds.layout["fingers"]]).sum(axis=1)
    covered_m = direction * float((width_m - start_m).mean())
    return {"direction": direction, "asked_m": min(WIDTH_CHANGE_M, widest_m), "covered_m": covered_m}


def _motion(tip: StateArray, world: WorldConfig) -> Measured:
    """Speed and acceleration of (T, E, 3) positions of the tip, metres, a step apart."""
    step_s = world.step_s
    velocity = np.diff(tip, axis=0) / step_s
    acceleration = np.diff(velocity, axis=0) / step_s
    outside = (tip < world.workspace.lower_m) | (tip > world.workspace.upper_m)
    return {
        "num_episodes": tip.shape[1],
        "tip_speed_m_s": _distribution(np.linalg.norm(velocity, axis=-1)),
        "tip_acceleration_m_s2": _distribution(np.linalg.norm(acceleration, axis=-1)),
        "outside_workspace": float(outside.any(axis=-1).mean()),  # share of steps
    }


def _distribution(values: StateArray) -> dict[str, float]:
    median, p99 = np.percentile(values, (50, 99))
    return {"median": float(median), "p99": float(p99), "max": float(values.max())}
