"""Calibration: how much of a commanded way an arm covers in a control step, and when it begins to move.

A policy knows the arm of its training, which covers some 60 % of an action in the step that it lasts. For an arm that
covers more, the bridge shortens the ways of actions so that what is covered is the same. For one that covers less it
changes nothing: sent further ahead of itself, a slow arm overshoots, and that costs far more (docs/robot.md).
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import yaml
from pydantic import Field, ValidationError

from service.base.errors import RobotError, TandemError
from service.base.files import write_atomic
from service.base.types import FloatArray, StateArray
from service.config.frozen import FrozenModel, first_error
from service.config.tree import read_yaml
from service.config.world import WorldConfig
from service.envs.batch import DISPLACEMENT_M
from service.envs.observations import ACTION, POSITIONS
from service.envs.robot import described
from service.robot.interface import RobotInterface
from service.robot.loop import Bridge, BridgeConfig
from service.robot.safety import SafetyConfig, always_held

_APPROACH_STEPS, _REST_STEPS, _MOVE_STEPS = 40, 10, 6
_LAST_STEPS = 2
"""Of a motion, in which an arm has found its speed."""
_ACTION, _APPROACH_ACTION = 0.4, 0.5
_MOVED_M = 5e-4
_LEAST_SHARE, _GREATEST_SHARE = 0.1, 2.0
_Share = Annotated[float, Field(gt=0.0)]
_Shares = tuple[_Share, _Share, _Share]
_DIRECTIONS = np.concatenate([np.eye(3), -np.eye(3)])
_AS_IN_TRAINING = BridgeConfig(
    pace=1.0,
    set_points_per_step=1,
    safety=SafetyConfig(max_speed_m_s=1e6, max_acceleration_m_s2=1e6, max_tracking_error_m=1.0),
)


class Calibration(FrozenModel):
    """The response of one robot to the set-points of one bridge, as ``tandem robot calibrate`` writes it."""

    robot: str = Field(description="its name: --robot, or name in its file")
    arm: str = Field(description="of the world that the policies were trained in")
    step_s: float
    set_points_per_step: int
    max_speed_m_s: float
    max_acceleration_m_s2: float
    covered_share: _Shares = Field(description="of a commanded way, x, y, z, that the arm covers in a control step")
    training_share: _Shares = Field(description="the same of the arm in training")
    delay_steps: float = Field(description="control steps from a command until the arm is seen to move")

    @property
    def gain(self) -> tuple[float, float, float]:
        """By what the ways of actions are multiplied, so that the arm covers no more than in training; 1 at most."""
        x, y, z = (
            min(wanted / found, 1.0) for wanted, found in zip(self.training_share, self.covered_share, strict=True)
        )
        return x, y, z

    def check(self, robot: str, world: WorldConfig, config: BridgeConfig) -> None:
        """Assert that this was measured of a robot as it is to be run.

        Raises:
            TandemError: it was measured of another one, or with other set-points.
        """
        for key, value in _setting(robot, world, config).items():
            if getattr(self, key) != value:
                raise TandemError(
                    f"calibration: measured with {key} {getattr(self, key)!r}, not {value!r}: calibrate again"
                )


def calibrate(
    name: str,
    robot: RobotInterface,
    world: WorldConfig,
    config: BridgeConfig,
    *,
    held: Callable[[], bool] = always_held,
) -> Calibration:
    """Measure a robot by small motions in the middle of its safety box, and the arm of training in MuJoCo.

    Args:
        name: of the robot.
        robot: with nothing in the way, its gripper inside the box.
        world: of the policies.
        config: of the bridge that will be used.
        held: the dead-man's switch.

    Raises:
        RobotError: it was stopped, or covers next to nothing or far too much.
    """
    from service.robot.mujoco_robot import MujocoRobot

    empty = world.model_copy(update={"fixture": "none", "fixtures": ()})  # people have cleared a real table
    wanted, _ = measure_response(MujocoRobot(empty), world, _AS_IN_TRAINING)
    full = config.model_copy(update={"pace": 1.0})
    found, delay_steps = measure_response(robot, world, full, held=held)
    if not all(_LEAST_SHARE <= share <= _GREATEST_SHARE for share in found):
        shares = ", ".join(f"{share:.0%}" for share in found)
        raise RobotError(
            f"robot {name}: it covers {shares} of a commanded step along x, y, z; "
            f"{_LEAST_SHARE:.0%} to {_GREATEST_SHARE:.0%} can be matched: look at its controller"
        )
    return Calibration(
        **_setting(name, world, config), covered_share=found, training_share=wanted, delay_steps=delay_steps
    )


def measure_response(
    robot: RobotInterface, world: WorldConfig, config: BridgeConfig, *, held: Callable[[], bool] = always_held
) -> tuple[_Shares, float]:
    """Move along each axis, there and back; ``covered_share`` and ``delay_steps`` of a ``Calibration``."""
    rows: list[dict[str, Any]] = []
    box = config.safety.box(world)
    motions = _Motions((box.lower_m + box.upper_m) / 2)
    bridge = Bridge(motions, robot, None, world, config, held=held, record=rows.append)
    bridge.run(np.zeros(3 * world.num_objects), motions.num_steps)
    effector = np.array([row["effector_m"] for row in rows])
    shares, delays = np.empty(len(_DIRECTIONS)), np.empty(len(_DIRECTIONS))
    for index, direction in enumerate(_DIRECTIONS):
        end = motions.first(index) + _MOVE_STEPS - 1
        covered = (effector[end] - effector[end - _LAST_STEPS]) @ direction / _LAST_STEPS
        shares[index] = covered / (DISPLACEMENT_M * _ACTION)
        delays[index] = _delay_s(rows[motions.first(index) :], direction)
    x, y, z = shares.reshape(2, 3).mean(axis=0).round(4).tolist()
    step_s = world.step_s
    seen = delays[np.isfinite(delays)]  # an arm that still swings back from the way before may hide one
    if not seen.size:
        raise RobotError(
            "calibration: the arm was not seen to move along any axis: look at what the robot says it is at"
        )
    return (x, y, z), round(float(seen.mean()) / step_s, 3)


def write_calibration(path: Path, calibration: Calibration) -> None:
    """Write a calibration as YAML.

    Raises:
        TandemError: the file cannot be written.
    """
    write_atomic(path, yaml.safe_dump(calibration.model_dump(mode="json"), sort_keys=False).encode())


def read_calibration(path: Path) -> Calibration:
    """Read what ``write_calibration`` wrote.

    Raises:
        TandemError: no such file, or none of these.
    """
    if not path.exists():
        raise TandemError(f"no calibration {path}: tandem robot calibrate --out {path} measures and writes one")
    try:
        return Calibration.model_validate(read_yaml(path))
    except ValidationError as error:
        raise TandemError(f"calibration {path}: {first_error(error)}; calibrate again") from None


class _Motions:
    """A policy that goes to the middle, rests, and moves along one axis; for each direction anew."""

    def __init__(self, middle_m: StateArray) -> None:
        self._middle_m = middle_m
        self._each = _APPROACH_STEPS + _REST_STEPS + _MOVE_STEPS
        self.num_steps = self._each * len(_DIRECTIONS) + _REST_STEPS
        self._step = 0

    def first(self, index: int) -> int:
        """First step of the motion along a direction."""
        return self._each * index + _APPROACH_STEPS + _REST_STEPS

    def act_deterministic(self, observation: FloatArray) -> FloatArray:
        """Bob's input (1, O) to an action (1, 4)."""
        index, step = divmod(self._step, self._each)
        self._step += 1
        action = np.zeros((1, ACTION.size), dtype=np.float32)
        if step < _APPROACH_STEPS:
            way = (self._middle_m - observation[0, POSITIONS["effector"]]) / DISPLACEMENT_M
            action[0, :3] = np.clip(_APPROACH_ACTION * way, -_APPROACH_ACTION, _APPROACH_ACTION)
        elif step >= _APPROACH_STEPS + _REST_STEPS and index < len(_DIRECTIONS):
            action[0, :3] = _ACTION * _DIRECTIONS[index]
        return action


def _delay_s(rows: list[dict[str, Any]], direction: StateArray) -> float:
    """Time from the first set-point of a motion until the arm is seen to move."""
    times = np.concatenate([row["tick_times_s"] for row in rows[:_MOVE_STEPS]])
    places = np.concatenate([row["measured_m"] for row in rows[:_MOVE_STEPS]])
    moved = (places - rows[0]["effector_m"]) @ direction > _MOVED_M
    return float(times[np.argmax(moved)] - times[0]) if moved.any() else np.inf


def _setting(robot: str, world: WorldConfig, config: BridgeConfig) -> dict[str, Any]:
    return {
        "robot": robot,
        "arm": described(world).name,
        "step_s": round(world.step_s, 9),
        "set_points_per_step": config.set_points_per_step,
        "max_speed_m_s": config.safety.max_speed_m_s,
        "max_acceleration_m_s2": config.safety.max_acceleration_m_s2,
    }
