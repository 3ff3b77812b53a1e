"""The control loop: what is measured becomes a policy's observation, its actions become set-points, 25 times a second.

An action means what it means in training (``WorldBatch.step``): a way of the end effector from where it is measured,
at most 5 cm an axis, and a change of the finger width. The way to the target is spread over the step's set-points.

Where the object is seen late, a policy sees the robot as it was then, and is told how long ago that was if it observes
its delay. A robot that is late itself is commanded from where it was seen, which makes it slower and keeps it stable.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np
from pydantic import Field

from service.actors.evaluation import DeterministicPolicy
from service.base.types import FloatArray, StateArray
from service.config.frozen import FrozenModel
from service.config.world import WorldConfig
from service.envs.batch import DISPLACEMENT_M, WIDTH_CHANGE_M
from service.envs.observations import ACTION, COMMAND_PREFIX, ObservationLayout, bob_observation, distances, layouts
from service.robot.interface import PoseSource, RobotInterface, RobotState
from service.robot.safety import SafeRobot, SafetyConfig, always_held

Record = Callable[[dict[str, Any]], None]
"""Takes what happened in a step: see ``Bridge.run``."""

_MORE_SETTLE_S = 0.5
"""Beyond the time that braking from the greatest speed takes."""


class BridgeConfig(FrozenModel):
    """How a policy is brought to a robot."""

    set_points_per_step: int = Field(
        10, ge=1, le=100, description="of a control step, evenly spread: 10 are 250 a second; 1 is a jump, as training"
    )
    pace: float = Field(
        0.7,
        gt=0.0,
        le=1.0,
        description="share of an action's way that is commanded. Behind a bound on acceleration an arm turns late, and "
        "at full pace it overshoots (docs/decisions/0025)",
    )
    safety: SafetyConfig = SafetyConfig()


class Bridge:
    """Plays a policy on a robot.

    Args:
        policy: acts on Bob's observations; one that has ``begin`` is told of every start.
        robot: that moves.
        poses: what sees the objects; None where nothing has to.
        world: of the policy: its step, its workspace, what it observes.
        config: of the bridge.
        gain: (3,) by which the ways of an action are multiplied; see ``calibrate``.
        held: the dead-man's switch.
        dry_run: command nothing.
        record: takes every step.

    Raises:
        ConfigError: an empty box.
    """

    def __init__(
        self,
        policy: DeterministicPolicy,
        robot: RobotInterface,
        poses: PoseSource | None,
        world: WorldConfig,
        config: BridgeConfig,
        *,
        gain: tuple[float, float, float] = (1.0, 1.0, 1.0),
        held: Callable[[], bool] = always_held,
        dry_run: bool = False,
        record: Record | None = None,
    ) -> None:
        self._policy, self._robot, self._config, self._record = policy, robot, config, record
        self._gain = config.pace * np.array(gain)
        self._layout = layouts(world).positions
        self._num_commands = world.observed.num_commands
        self._blocked = world.gripper == "blocked"
        self._step_s = world.step_s
        self._tick_s = self._step_s / config.set_points_per_step
        self.safe = SafeRobot(robot, poses, config.safety, world, held=held, dry_run=dry_run)
        """The only way to the robot."""

    def run(self, goal_m: StateArray, num_steps: int, *, truth: Callable[[], StateArray] | None = None) -> float:
        """Play one goal, and come to rest.

        What is recorded of a step: ``step``; ``time_s`` and ``due_s`` of its begin; ``effector_m``, ``fingers_m``,
        ``object_m`` as measured then, with ``state_time_s`` and ``object_time_s``; ``goal_m``, ``action``,
        ``target_m``, ``width_m``; and of its ticks ``tick_times_s``, ``set_points_m``, ``measured_m``. A step in which
        the robot is stopped has ``stopped``, the reason, too.

        Args:
            goal_m: (3 K,) where each object should go, metres.
            num_steps: control steps.
            truth: of a simulator, (3 K,) where the objects are, metres.

        Returns:
            Distance from the object that is furthest from its goal to there at the end of the last step, metres: in
            truth, or else as it was last seen, and NaN where nothing sees them.

        Raises:
            RobotError: the robot was stopped; the message says why.
        """
        begin = getattr(self._policy, "begin", None)
        if begin is not None:
            begin()
        self._commands = deque([np.zeros(ACTION.size)] * self._num_commands, maxlen=self._num_commands)
        most = math.ceil(self._config.safety.watch.max_pose_age_s / self._step_s) + 2
        self._states: deque[RobotState] = deque(maxlen=most)  # to which an object's pose may belong, one a step
        with self.safe.guarded():
            self.safe.start(self._tick_s)
            start_s = self._robot.now_s()
            for step in range(num_steps):
                due_s = start_s + step * self._step_s
                row: dict[str, Any] = {"step": step, "due_s": due_s, "goal_m": goal_m}
                try:
                    self._play_step(row, due_s, goal_m)
                except BaseException as error:
                    self.safe.stop(f"{type(error).__name__}: {error}")
                    row["stopped"] = self.safe.stopped  # the first reason
                    raise
                finally:
                    if self._record is not None:
                        self._record(row)
            end_s = start_s + num_steps * self._step_s
            self.safe.measure(end_s)
            object_m = self.safe.object.position_m if truth is None else truth().copy()
            self._settle(end_s)
        return float(distances(object_m, goal_m).max())

    def _play_step(self, row: dict[str, Any], due_s: float, goal_m: StateArray) -> None:
        safe = self.safe
        row["time_s"] = self._robot.now_s()
        safe.measure(due_s)
        state, object_m, object_time_s = safe.state, safe.object.position_m, safe.object.time_s
        row |= {"effector_m": state.effector_m, "fingers_m": state.fingers_m, "object_m": object_m}
        row |= {"state_time_s": state.time_s, "object_time_s": object_time_s}
        self._states.append(state)
        then = state
        if np.isfinite(object_time_s):  # nothing sees the object where an arm is calibrated
            then = min(reversed(self._states), key=lambda each: abs(each.time_s - object_time_s))
        delay_steps = max(0, round((state.time_s - then.time_s) / self._step_s))
        observation = observe(self._layout, then, object_m, self._commands, goal_m, delay_steps)
        action = self._policy.act_deterministic(observation)[0].astype(np.float64)
        row["action"] = action
        safe.check_finite(action, "the policy's action")
        action = np.clip(action, -1.0, 1.0)
        self._commands.appendleft(action)
        target_m = state.effector_m + DISPLACEMENT_M * self._gain * action[:3]
        # A gripper that was held closed in training ignored the width that the policy asked for.
        width_m = 0.0 if self._blocked else float(state.fingers_m.sum() + WIDTH_CHANGE_M * action[3])
        row |= {"target_m": target_m, "tick_times_s": [], "set_points_m": [], "measured_m": []}
        num = self._config.set_points_per_step
        for tick in range(num):
            tick_s = due_s + tick * self._tick_s
            if tick:
                safe.measure(tick_s)
            safe.move(target_m, width_m, (num - tick) * self._tick_s)
            row["width_m"] = safe.width_m
            row["tick_times_s"].append(self._robot.now_s())
            row["set_points_m"].append(safe.limiter.position_m)
            row["measured_m"].append(safe.state.effector_m)
            safe.wait_until(tick_s + self._tick_s)

    def _settle(self, now_s: float) -> None:
        """Bring the set-point to rest."""
        safety = self._config.safety
        most_s = safety.max_speed_m_s / safety.max_acceleration_m_s2 + _MORE_SETTLE_S
        for tick in range(1, math.ceil(most_s / self._tick_s)):
            self.safe.brake()
            if self.safe.limiter.is_still:
                return
            self.safe.wait_until(now_s + tick * self._tick_s)
            self.safe.measure(now_s + tick * self._tick_s)


def observe(
    layout: ObservationLayout,
    state: RobotState,
    object_m: StateArray,
    commands: deque[StateArray],
    goal_m: StateArray,
    delay_steps: int,
) -> FloatArray:
    """(1, O) Bob's input: the entries of his positions from what was measured, and the goal.

    Args:
        layout: of his positions.
        state: of the robot.
        object_m: (3 K,) where the objects were seen, metres.
        commands: (4,) each, the newest first: what the policy asked for in the last steps.
        goal_m: (3 K,) metres.
        delay_steps: by which what is seen, or what is commanded, is late.
    """
    measured: dict[str, StateArray | int] = {
        "effector": state.effector_m,
        "fingers": state.fingers_m,
        "object": object_m,
        "object_from_effector": object_m - np.tile(state.effector_m, len(object_m) // 3),
        "delay": delay_steps,
        **{f"{COMMAND_PREFIX}{age}": command for age, command in enumerate(commands, start=1)},
    }
    positions = np.empty((1, layout.size), dtype=np.float32)
    for name, part in layout.columns.items():
        positions[0, part] = measured[name]
    return bob_observation(positions, goal_m[None])
