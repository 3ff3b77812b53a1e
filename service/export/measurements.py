"""What a bridge must know of a policy and is measured rather than read: response, motion, late observations.

A robot that follows the action's words instead, 5 cm a step, or sees the object later than the policy was trained to,
fails where the simulator does not. Everything here is played in the policy's own world.
"""

from __future__ import annotations

from collections import deque

import numpy as np
from pydantic import Field

from service.actors.evaluation import REPORTED_SEED, DeterministicPolicy, evaluate
from service.base.types import FloatArray, StateArray
from service.config import WorldConfig
from service.config.frozen import FrozenModel
from service.envs.batch import DISPLACEMENT_M, WIDTH_CHANGE_M, WorldBatch
from service.envs.observations import COMMAND_PREFIX, DELAY, ObservationLayout, bob_observation, layouts
from service.registry.loading import Trained

_NUM_PLACES = 64
_FROM_EDGE_M = 0.05
"""Distance of the places from the workspace's edge, so that no command is clipped."""
_ABOVE_OBJECT_M = 0.12
"""Of the lowest place; two full steps down end above the object."""
_MAX_LATE_STEPS = 2
_TOLERATED_LOSS = 0.1


class AxisResponse(FrozenModel):
    """Share of a full action's displacement that is covered by the end of its step, over places in the workspace."""

    axis: str = Field(description="x, y or z in the world frame")
    direction: int = Field(description="1 or -1")
    from_rest_mean: float = Field(description="in the first step, from rest")
    from_rest_std: float
    moving_mean: float = Field(description="in the second of two such steps")
    moving_std: float


class WidthResponse(FrozenModel):
    """Way of the gripper in one step of a full action that changes its width."""

    direction: int = Field(description="1: opening, from closed; -1: closing, from open")
    asked_m: float
    covered_m: float = Field(description="by the end of the first step")


class Distribution(FrozenModel):
    """Median, 99th percentile and greatest of what was measured."""

    median: float
    p99: float
    max: float


class Motion(FrozenModel):
    """Motion of the end effector in evaluation episodes, from its positions at the steps' ends."""

    num_episodes: int
    tip_speed_m_s: Distribution
    tip_acceleration_m_s2: Distribution
    outside_workspace: float = Field(description="share of steps at whose end it is outside the box of training")


class LateObservations(FrozenModel):
    """Success at the last step where the policy sees positions as they were some steps ago.

    One that observes its delay is told it.
    """

    steps: int
    success_last: float
    success_last_low: float = Field(description="lower end of the 95 % Wilson interval")
    success_last_high: float


class Measured(FrozenModel):
    """Everything that is measured."""

    response: tuple[AxisResponse, ...]
    width_response: tuple[WidthResponse, ...]
    motion: Motion
    late_observations: tuple[LateObservations, ...]

    @property
    def tolerated_late_steps(self) -> int:
        """Greatest delay, of those measured, up to which success is within 10 points of that without delay."""
        least = self.late_observations[0].success_last - _TOLERATED_LOSS
        good = [late.success_last >= least for late in self.late_observations]
        return good.index(False) - 1 if False in good else len(good) - 1


def measure(trained: Trained, num_episodes: int) -> tuple[Measured, FloatArray]:
    """Measure a policy and its arm on random goals of its world; takes seconds.

    Returns:
        What was measured; and (T, E, O) observations of the episodes without delay, T steps and the start, E episodes.
    """
    observations: list[FloatArray] = []
    tip: list[StateArray] = []

    def record(worlds: WorldBatch, goal: StateArray) -> None:
        observations.append(bob_observation(worlds.positions(), goal))
        tip.append(worlds.ee_position.copy())

    layout = layouts(trained.world).bob
    late = []
    for steps in range(_MAX_LATE_STEPS + 1):
        found = evaluate(
            _Late(trained.player(), steps, layout),
            trained.world,
            trained.goals,
            num_episodes=num_episodes,
            num_steps=trained.num_steps,
            success_distance_m=trained.success_distance_m,
            seed=REPORTED_SEED,
            observe=record if steps == 0 else None,
        )
        late.append(
            LateObservations(
                steps=steps,
                success_last=found.success_last,
                success_last_low=found.success_last_low,
                success_last_high=found.success_last_high,
            )
        )
    response, width_response = measure_response(trained.world)
    measured = Measured(
        response=response,
        width_response=width_response,
        motion=_motion(np.stack(tip), trained.world),
        late_observations=tuple(late),
    )
    return measured, np.stack(observations)


def measure_response(world: WorldConfig) -> tuple[tuple[AxisResponse, ...], tuple[WidthResponse, ...]]:
    """Measure how far the arm and the gripper come in the step of a full action, without anything in their way."""
    empty = world.model_copy(update={"fixture": "none", "fixtures": ()})
    rng = np.random.default_rng(REPORTED_SEED)
    with WorldBatch(empty, _NUM_PLACES) as worlds:
        response = tuple(_axis_response(worlds, rng, axis, direction) for axis in range(3) for direction in (1, -1))
        widest_m = worlds.robot.opening_m if world.gripper == "free" else 0.0
        widths = tuple(_width_response(worlds, rng, direction, widest_m) for direction in (1, -1))
    return response, widths


class _Late:
    """A policy that sees positions of some steps ago, but knows its own commands, and the delay if it observes it."""

    def __init__(self, policy: DeterministicPolicy, num_steps: int, layout: ObservationLayout) -> None:
        self._policy, self._num_steps = policy, num_steps
        names = [entry.name for entry in layout.entries]
        self._known = [layout[name] for name in names if name.startswith(COMMAND_PREFIX)]
        self._delay = [layout[name] for name in names if name == DELAY]
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
    lower[2] = min(worlds.config.shape.extent_m[2] + _ABOVE_OBJECT_M, upper[2])
    places = worlds.reach.clip(rng.uniform(lower, upper, (worlds.num_worlds, 3)))
    worlds.reset(rng)
    states = worlds.states.copy()
    states[:, worlds.layout["joints"]] = worlds.robot.arm.solve(worlds.joints, places, num_iterations=30)
    states[:, worlds.layout["fingers"]] = worlds.robot.finger_values(np.full(worlds.num_worlds, width_m))
    worlds.restore(states)


def _axis_response(worlds: WorldBatch, rng: np.random.Generator, axis: int, direction: int) -> AxisResponse:
    _place(worlds, rng, 0.0)
    actions = np.zeros((worlds.num_worlds, 4), dtype=np.float32)
    actions[:, axis] = direction
    shares = []
    for _ in range(2):
        before = worlds.ee_position.copy()
        worlds.step(actions)
        shares.append(direction * (worlds.ee_position - before)[:, axis] / DISPLACEMENT_M)
    rest, moving = shares
    return AxisResponse(
        axis="xyz"[axis],
        direction=direction,
        from_rest_mean=float(rest.mean()),
        from_rest_std=float(rest.std()),
        moving_mean=float(moving.mean()),
        moving_std=float(moving.std()),
    )


def _width_response(worlds: WorldBatch, rng: np.random.Generator, direction: int, widest_m: float) -> WidthResponse:
    start_m = 0.0 if direction > 0 else widest_m
    _place(worlds, rng, start_m)
    actions = np.zeros((worlds.num_worlds, 4), dtype=np.float32)
    actions[:, 3] = direction
    worlds.step(actions)
    width_m = worlds.robot.openings(worlds.states[:, worlds.layout["fingers"]]).sum(axis=1)
    covered_m = direction * float((width_m - start_m).mean())
    return WidthResponse(direction=direction, asked_m=min(WIDTH_CHANGE_M, widest_m), covered_m=covered_m)


def _motion(tip: StateArray, world: WorldConfig) -> Motion:
    """Speed and acceleration of (T, E, 3) positions of the tip, metres, a step apart."""
    step_s = world.physics_step_s * world.num_substeps
    velocity = np.diff(tip, axis=0) / step_s
    acceleration = np.diff(velocity, axis=0) / step_s
    outside = (tip < world.workspace.lower_m) | (tip > world.workspace.upper_m)
    return Motion(
        num_episodes=tip.shape[1],
        tip_speed_m_s=_distribution(np.linalg.norm(velocity, axis=-1)),
        tip_acceleration_m_s2=_distribution(np.linalg.norm(acceleration, axis=-1)),
        outside_workspace=float(outside.any(axis=-1).mean()),
    )


def _distribution(values: StateArray) -> Distribution:
    median, p99 = np.percentile(values, (50, 99))
    return Distribution(median=float(median), p99=float(p99), max=float(values.max()))
