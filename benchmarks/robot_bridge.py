"""A frozen policy through the bridge to robots: how often it reaches its goals, beside the evaluator.

    python -m benchmarks.robot_bridge --json docs/results/robot_bridge.json

The same starts and goals in every row. What is changed is what lies between policy and arm: bounds on the set-points,
an arm that follows its set-points as closely as real ones do, and what is seen late, with noise or an offset. What an
arm covers of a command is measured by ``calibrate`` and matched. What the file has of rows that are not measured now
stays if it was measured with the same settings.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.measuring import parser_of, run_benchmark
from benchmarks.report.markdown import percent, table
from service.actors.evaluation import evaluate, wilson_interval
from service.robot.backends import Backend, BackendConfig, connect
from service.robot.calibrate import calibrate
from service.robot.errors import RobotError
from service.robot.loop import Bridge, BridgeConfig
from service.robot.policies import RobotPolicy, load_robot_policy
from service.robot.running import play
from service.types import StateArray

_JUMPS = {
    "set_points_per_step": 1,
    "safety": {"max_speed_m_s": 1e6, "max_acceleration_m_s2": 1e6, "max_tracking_error_m": 1.0},
}
_CLOSE = {"backend": "mujoco", "parameters": {"feed_forward": 1.0, "physics_step_s": 0.004}}
_SEEN_WRONG = {"pose_noise_m": 0.005, "pose_offset_m": (0.01, 0.0, 0.0)}


@dataclass(frozen=True, slots=True)
class Row:
    """One way from policy to arm."""

    backend: dict[str, Any] = field(default_factory=lambda: {"backend": "mujoco"})
    bridge: dict[str, Any] = field(default_factory=dict)
    calibrated: bool = True


ROWS = {
    "set-points that jump, no bounds, as in training": Row(bridge=_JUMPS, calibrated=False),
    "the same, observations one step late": Row(bridge={**_JUMPS, "observation_delay_steps": 1}, calibrated=False),
    "bounds of a Franka, the arm of training": Row(),
    "bounds of a Franka, an arm that follows closely": Row(_CLOSE),
    "the same, its response not matched": Row(_CLOSE, calibrated=False),
    "the same, matched, observations one step late": Row(_CLOSE, bridge={"observation_delay_steps": 1}),
    "the same, matched, object noise 5 mm and offset 1 cm": Row({**_CLOSE, "disturbance": _SEEN_WRONG}),
}


@dataclass(frozen=True, slots=True)
class Settings:
    """Amount of what is measured."""

    policy: str = "panda-cube@champion"
    num_episodes: int = 300
    num_steps: int = 50
    seed: int = 1_000_004


class _Motion:
    """Greatest speed and acceleration of set-points, from their times and places alone."""

    def __init__(self) -> None:
        self.speed_m_s = self.acceleration_m_s2 = 0.0
        self._times: list[float] = []
        self._places: list[StateArray] = []

    def record(self, row: dict[str, Any]) -> None:
        """Take a step."""
        self._times += row.get("tick_times_s", [])
        self._places += row.get("set_points_m", [])

    def end_episode(self) -> None:
        """Take in what the episode had."""
        times, first = np.unique(self._times, return_index=True)
        places = np.array(self._places)[first]
        velocity = np.diff(places, axis=0) / np.diff(times)[:, None]
        change = np.diff(velocity, axis=0) / np.diff(times)[1:, None]
        self.speed_m_s = max(self.speed_m_s, float(np.linalg.norm(velocity, axis=1).max(initial=0.0)))
        most = float(np.linalg.norm(change, axis=1).max(initial=0.0))
        self.acceleration_m_s2 = max(self.acceleration_m_s2, most)
        self._times, self._places = [], []


def measure_row(row: Row, policy: RobotPolicy, settings: Settings) -> dict[str, Any]:
    """Success, stops and motion of one row."""
    described, config = BackendConfig.model_validate(row.backend), BridgeConfig.model_validate(row.bridge)
    backend = connect(described, policy.world, seed=settings.seed)
    share, gain = None, (1.0, 1.0, 1.0)
    if row.calibrated:
        undisturbed = connect(BackendConfig(backend=described.backend, parameters=described.parameters), policy.world)
        found = calibrate(described.label, undisturbed.robot, policy.world, config)
        share, gain = found.covered_share, found.gain
    motion = _Motion()
    bridge = Bridge(policy.policy, backend.robot, backend.poses, policy.world, config, gain=gain, record=motion.record)
    num_reached, stops = _play(bridge, backend, policy, settings, motion)
    low, high = wilson_interval(num_reached, settings.num_episodes)
    return {
        "covered_share": share,
        "gain": gain if row.calibrated else None,
        "success_last": num_reached / settings.num_episodes,
        "success_last_low": low,
        "success_last_high": high,
        "stops": stops,
        "max_set_point_speed_m_s": motion.speed_m_s,
        "max_set_point_acceleration_m_s2": motion.acceleration_m_s2,
    }


def _play(
    bridge: Bridge, backend: Backend, policy: RobotPolicy, settings: Settings, motion: _Motion
) -> tuple[int, list[str]]:
    """Goals reached, and why the robot was stopped in others; a stop is a failure, and the next goal follows."""
    num_reached, stops, first = 0, list[str](), 0
    while first < settings.num_episodes:
        outcomes = play(
            bridge, backend, policy, goal_m=None, num_episodes=settings.num_episodes, num_steps=settings.num_steps,
            seed=settings.seed, first=first, ready=lambda episode, goal: None,
        )  # fmt: skip
        try:
            for outcome in outcomes:
                motion.end_episode()
                num_reached += outcome.reached
                first += 1
        except RobotError as error:
            motion.end_episode()
            stops.append(str(error))
            first += 1
            bridge.safe.release()
    return num_reached, stops


def report(result: Mapping[str, Any]) -> str:
    """A result for people."""
    rows = [("the evaluator, without the bridge", percent(result["evaluator"]["success_last"], 1), "", "")]
    for name, row in result["rows"].items():
        motion = f"{row['max_set_point_speed_m_s']:.2f} m/s, {row['max_set_point_acceleration_m_s2']:.1f} m/s2"
        rows.append((name, percent(row["success_last"], 1), str(len(row["stops"])), motion))
    return table(("between policy and arm", "success at the last step", "stops", "most of its set-points"), rows)


def main() -> int:
    """Parse the command line, measure, print."""
    parser = parser_of(__doc__, Settings())
    numbers = range(len(ROWS))
    parser.add_argument("--rows", nargs="*", type=int, choices=numbers, help="numbers of rows; default: all")
    given = parser.parse_args()
    return run_benchmark(
        "robot_bridge", ("mujoco", "numpy"), given, Settings, lambda chosen: _benchmark(chosen, given), report
    )


def _measured_before(settings: Settings, path: Path | None) -> dict[str, Any]:
    """Rows of an earlier result with the same settings."""
    if path is None or not path.exists():
        return {}
    found = json.loads(path.read_text(encoding="utf-8"))
    return dict(found["rows"]) if found["settings"] == asdict(settings) else {}


def _benchmark(settings: Settings, given: argparse.Namespace) -> dict[str, Any]:
    before = _measured_before(settings, given.json)
    policy = load_robot_policy(settings.policy, Path("registry"))
    evaluation = evaluate(
        policy.policy,
        policy.world,
        policy.goals,
        num_episodes=settings.num_episodes,
        num_steps=settings.num_steps,
        success_distance_m=policy.success_distance_m,
        seed=settings.seed,
    )
    for number, (name, row) in enumerate(ROWS.items()):
        if given.rows is None or number in given.rows:
            before[name] = measure_row(row, policy, settings)
            print(f"{name}: {before[name]['success_last']:.1%}", flush=True)
    return {"evaluator": evaluation.as_dict(), "rows": {name: before[name] for name in ROWS if name in before}}


if __name__ == "__main__":
    raise SystemExit(main())
