"""A frozen policy in an engine nobody here wrote, through the project's own bridge: docs/results/transfer.md.

    python -m benchmarks.transfer --policy panda-cube@champion --json docs/results/transfer.json

Every row has the same policy and the same bridge; rows differ in the back-end, and in what ``calibrate`` measures of
it. Goals are played in chunks, each with an engine and noise of its own.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np

from benchmarks.measuring import run_benchmark
from benchmarks.report.markdown import measured_on, percent
from service.actors.evaluation import evaluate
from service.base.errors import RobotError
from service.base.intervals import wilson_interval
from service.base.markdown import table
from service.base.types import BoolArray, StateArray
from service.envs.sampling import draw_first, draw_goals
from service.registry.loading import Trained, load
from service.robot.backends import Backend, BackendConfig, Simulator, connect
from service.robot.calibrate import Calibration, calibrate
from service.robot.disturbed import DisturbanceConfig
from service.robot.loop import Bridge, BridgeConfig
from service.robot.pybullet_robot import CONTROL_STEP_S, PyBulletParameters, PyBulletRobot, world_of
from service.robot.running import for_robot
from service.robot.safety import SafetyConfig
from service.robot.watchdogs import WatchConfig

Gain = tuple[float, float, float]
CHUNK = 25
"""Goals of one engine."""
SPEED_M_S, ACCELERATION_M_S2 = 1.7, 13.0
"""Limits of a Franka's Cartesian motion."""
BRIDGE = BridgeConfig(
    set_points_per_step=10,
    safety=SafetyConfig(
        max_speed_m_s=SPEED_M_S,
        max_grip_force_n=140.0,  # a Franka hand's greatest: the cube is ten times as heavy as in training
        watch=WatchConfig(max_state_age_s=0.2, max_pose_age_s=0.25),  # two steps late, and some more
    ),
)
"""Of all rows."""
_REST_STEPS = 4
"""More than the greatest delay of a row."""
RESPONSES = (0.4, 0.55, 0.7, 0.85, 1.0)


@dataclass(frozen=True, slots=True)
class Settings:
    """What is played, and how it is brought to a robot."""

    policy: str = "panda-cube@champion"
    larger: str = ""
    """Directory of an orchestrator for Larger; none by default, and then its row is not measured."""
    wall: str = ""
    """The same for Wall."""
    registry: str = "registry"
    num_goals: int = 300
    """Of each seed."""
    num_steps: int = 50
    seed: int = 0
    num_seeds: int = 1
    """Seeds of goals, from ``seed`` on."""


@dataclass(frozen=True, slots=True)
class Row:
    """One line of the table."""

    title: str
    asked: float
    """Success at the last step."""
    policy: Literal["policy", "larger", "wall"] = "policy"
    parameters: Mapping[str, Any] = field(default_factory=dict)
    """Of the engine."""
    disturbance: DisturbanceConfig = field(default_factory=DisturbanceConfig)
    backend: str = "pybullet"


def _late(num_steps: int, **others: Any) -> DisturbanceConfig:
    """Everything that is observed, ``num_steps`` control steps late."""
    late_s = num_steps * CONTROL_STEP_S
    return DisturbanceConfig(state_delay_s=late_s, pose_delay_s=late_s, **others)


ROWS = {
    "nominal": Row("panda-gym's arm and cube", 0.97),
    "together": Row(
        "observations one step late, object noise 5 mm, offset 1 cm, together",
        0.90,
        disturbance=_late(1, pose_noise_m=0.005, pose_offset_m=(0.01, 0.0, 0.0)),
    ),
    "late": Row("observations two steps late (80 ms)", 0.85, disturbance=_late(2)),
    "noise": Row("object noise 10 mm", 0.90, disturbance=DisturbanceConfig(pose_noise_m=0.01)),
    **{
        f"response-{100 * share:.0f}": Row(
            f"an arm that covers {100 * share:.0f} % of a displacement in a step", 0.92, parameters={"response": share}
        )
        for share in RESPONSES
    },
    "larger": Row("orchestrator of *Larger*", 0.93, policy="larger"),
    "wall": Row("orchestrator of *Wall*", 0.93, policy="wall"),
    "mujoco": Row("the world of training, through the bridge", 0.95, backend="mujoco"),
}
"""Rows by name."""
LIMITED = "nominal"
"""The row whose tip is asked to stay inside a Franka's limits, with success of ``LIMITED_SUCCESS``."""
LIMITED_SUCCESS = 0.95


@dataclass(frozen=True, slots=True)
class Played:
    """One goal."""

    reached: bool
    """At the last step."""
    ever: bool
    stopped: str
    """Why the robot was stopped; empty where it was not."""
    inside: tuple[int, int]
    """Control steps with the tip, and with the set-point, inside a Franka's limits."""
    num_steps: int
    free: tuple[int, int] = (0, 0)
    """Control steps in which the arm touches nothing, and those of them with the tip inside; none where unknown."""


def policy_of(row: Row, settings: Settings) -> Trained:
    """The policy of a row, in the world of its back-end."""
    found = for_robot(load(getattr(settings, row.policy), settings.registry))
    if row.backend != "pybullet":
        return found
    world = world_of(found.config.world, PyBulletParameters(**row.parameters))
    return replace(found, config=found.config.model_copy(update={"world": world}))


def calibrate_row(row: Row, settings: Settings) -> Calibration:
    """What ``tandem robot calibrate`` measures of a row's back-end."""
    world = policy_of(row, settings).world
    backend = connect(_backend(row), world)
    try:
        assert backend.simulator is not None
        x, y, _ = world.workspace.upper_m  # out of the way
        backend.simulator.reset(np.array([x, y, world.rest_height_m]))
        return calibrate(row.backend, backend.robot, world, BRIDGE)
    finally:
        backend.close()


def play_chunk(row: Row, chunk: int, settings: Settings, gain: Gain) -> list[Played]:
    """Play the goals of a chunk, one after the other; ``gain`` is what was calibrated."""
    policy = policy_of(row, settings)
    starts, goals = draw_episodes(policy, settings)
    mine = slice(chunk * CHUNK, (chunk + 1) * CHUNK)
    backend = connect(_backend(row), policy.world, seed=1_000 * settings.seed + chunk)
    try:
        assert backend.simulator is not None
        played = []
        for start, goal in zip(starts[mine], goals[mine], strict=True):
            backend.simulator.reset(start)
            _rest(backend)
            played.append(_play(policy, backend, goal, settings, gain))
        return played
    finally:
        backend.close()


def draw_episodes(policy: Trained, settings: Settings) -> tuple[StateArray, StateArray]:
    """(N, 3) places of the object at first, and (N, 3) goals, metres: the same as of an evaluation in MuJoCo."""
    rng = np.random.default_rng(settings.seed)
    places = draw_first(rng, settings.num_goals, policy.world)
    return places.object, draw_goals(policy.goal_kind, rng, policy.world, policy.success_distance_m, places)


def inside_limits(positions_m: StateArray, gap_s: float) -> StateArray:
    """(T,) whether speed and acceleration of (T + 2, 3) positions, ``gap_s`` apart, are a Franka's at each moment."""
    velocity = np.diff(positions_m, axis=0) / gap_s
    acceleration = np.diff(velocity, axis=0) / gap_s
    inside: StateArray = (np.linalg.norm(velocity[1:], axis=1) <= SPEED_M_S * 1.001) & (
        np.linalg.norm(acceleration, axis=1) <= ACCELERATION_M_S2 * 1.001
    )
    return inside


def _rest(backend: Backend) -> None:
    """Let some time pass, so that what is read late is no longer of the episode before."""
    for _ in range(_REST_STEPS):
        backend.robot.read()
        backend.poses.read()
        backend.robot.wait_until(backend.robot.now_s() + CONTROL_STEP_S)


def _play(policy: Trained, backend: Backend, goal: StateArray, settings: Settings, gain: Gain) -> Played:
    simulator = backend.simulator
    assert simulator is not None
    distances: list[float] = []
    tip: list[StateArray] = []
    set_points: list[StateArray] = []
    touches = [_num_touching_steps(simulator)]  # physics steps with a touch, at the start and after each step

    def record(step: Mapping[str, Any]) -> None:
        touches.append(_num_touching_steps(simulator))
        distances.append(float(np.linalg.norm(simulator.object_position() - goal)))
        tip.extend(step.get("measured_m", ()))
        set_points.extend(step.get("set_points_m", ()))

    world, num = policy.world, BRIDGE.set_points_per_step
    bridge = Bridge(policy.policy, backend.robot, backend.poses, world, BRIDGE, gain=gain, record=record)
    stopped = ""
    try:
        bridge.run(goal, settings.num_steps)
    except RobotError as error:
        stopped = str(error)
    last = float(np.linalg.norm(simulator.object_position() - goal))
    gap_s = world.step_s / num
    insides = [_steps_inside(np.array(path), gap_s, num) for path in (tip, set_points)]
    free = np.diff(touches) == 0
    return Played(
        reached=not stopped and last <= policy.success_distance_m,
        ever=min([*distances, last]) <= policy.success_distance_m,
        stopped=stopped,
        inside=(int(insides[0].sum()), int(insides[1].sum())),
        num_steps=len(distances),
        free=(int(free.sum()), int((free & insides[0]).sum())),
    )


def _num_touching_steps(simulator: Simulator) -> float:
    """How often the arm has touched something; NaN, unequal to itself, where that is not counted."""
    return simulator.num_touching_steps if isinstance(simulator, PyBulletRobot) else np.nan


def _steps_inside(path: StateArray, gap_s: float, num_ticks: int) -> BoolArray:
    """Control steps all of whose moments are inside the limits; the first two moments have no acceleration."""
    if len(path) < 3:
        return np.zeros(-(-len(path) // num_ticks), dtype=np.bool_)
    inside = np.concatenate([[True, True], inside_limits(path, gap_s)])
    return np.array([inside[at : at + num_ticks].all() for at in range(0, len(inside), num_ticks)])


def _backend(row: Row) -> BackendConfig:
    return BackendConfig(backend=row.backend, parameters=dict(row.parameters), disturbance=row.disturbance)


def summarise(played: Sequence[Played]) -> dict[str, Any]:
    """Rates of a row, for JSON."""
    num = len(played)
    rates: dict[str, Any] = {"num_goals": num}
    for name, hits in {"last": [each.reached for each in played], "ever": [each.ever for each in played]}.items():
        low, high = wilson_interval(sum(hits), num)
        rates |= {f"success_{name}": sum(hits) / num, f"success_{name}_low": low, f"success_{name}_high": high}
    steps = max(sum(each.num_steps for each in played), 1)
    tip, set_point = (sum(each.inside[index] for each in played) / steps for index in (0, 1))
    reasons = sorted({each.stopped for each in played if each.stopped})
    rates |= {"tip_inside": tip, "set_point_inside": set_point}
    if num_free := sum(each.free[0] for each in played):
        rates |= {"free": num_free / steps, "free_tip_inside": sum(each.free[1] for each in played) / num_free}
    return rates | {"num_stops": sum(bool(each.stopped) for each in played), "stops": reasons[:3]}


def benchmark(settings: Settings) -> dict[str, Any]:
    """Everything measured, for JSON."""
    names = [name for name, row in ROWS.items() if getattr(settings, row.policy)]
    policy = for_robot(load(settings.policy, settings.registry))
    seeds = [replace(settings, seed=settings.seed + index) for index in range(settings.num_seeds)]
    rows: dict[str, Any] = {}
    for name in names:
        begun, row = time.perf_counter(), ROWS[name]
        calibration = calibrate_row(row, settings)
        chunks = range(-(-settings.num_goals // CHUNK))
        of_seeds = [
            [each for chunk in chunks for each in play_chunk(row, chunk, of_seed, calibration.gain)]
            for of_seed in seeds
        ]
        rows[name] = {
            **summarise([each for played in of_seeds for each in played]),
            "success_last_each": [summarise(played)["success_last"] for played in of_seeds],
            **{"title": row.title, "asked": row.asked, "policy": getattr(settings, row.policy)},
            **{"calibration": calibration.model_dump(mode="json"), "gain": list(calibration.gain)},
            "wall_s": round(time.perf_counter() - begun, 1),
        }
        print(f"{name}: {rows[name]['success_last']:.1%} in {rows[name]['wall_s']:.0f} s", flush=True)
    without = evaluate(
        policy.policy,
        policy.world,
        "mixed",
        num_episodes=settings.num_goals * settings.num_seeds,
        num_steps=settings.num_steps,
        success_distance_m=policy.success_distance_m,
        seed=settings.seed,
    )
    return {
        "policy": {"label": policy.label, "digest": policy.digest},
        "bridge": BRIDGE.model_dump(mode="json"),
        "engine": PyBulletParameters().model_dump(mode="json"),
        "rows": rows,
        "nominal_world": without.as_dict(),
    }


def transfer_table(result: Mapping[str, Any]) -> str:
    """Success of every row that was measured, beside what was asked."""
    rows = []
    for name, row in ROWS.items():
        if name not in result["rows"]:
            rows.append((row.title, "", "", "", percent(row.asked), "not measured"))
            continue
        each = result["rows"][name]
        last = f"{percent(each['success_last'], 1)} {_interval(each, 'last')}"
        if len(of_seeds := each.get("success_last_each", ())) > 1:
            last += ": " + ", ".join(percent(share, 1) for share in of_seeds)
        reached = "yes" if each["success_last"] >= row.asked else "no"
        covered = ", ".join(percent(share) for share in each["calibration"]["covered_share"])
        rows.append((row.title, last, percent(each["success_ever"], 1), covered, percent(row.asked), reached))
    head = ("", "success at the last step", "ever", "covered a step, x, y, z", "asked", "reached")
    return table(head, rows)


def transfer_words(result: Mapping[str, Any]) -> str:
    """What was played, the motion of the tip, the stops, and where it was measured."""
    rows, safety = result["rows"], result["bridge"]["safety"]
    num_goals = sorted({row["num_goals"] for row in rows.values()})
    num_seeds = result["settings"].get("num_seeds", 1)
    seeds = "" if num_seeds == 1 else f" of {num_seeds} seeds of goals, each of which has its share after the interval"
    words = [
        f"{result['policy']['label']}, {', '.join(map(str, num_goals))} goals a row{seeds}, "
        f"{result['settings']['num_steps']} steps; 95 % Wilson intervals. In the nominal world of training and without "
        f"the bridge it reaches {percent(result['nominal_world']['success_last'], 1)} of such goals."
    ]
    if LIMITED in rows:
        each = rows[LIMITED]
        words.append(
            f"In the first row the set-points stay inside {SPEED_M_S:g} m/s and {ACCELERATION_M_S2:g} m/s2 in "
            f"{percent(each['set_point_inside'], 1)} of steps and the tip itself in {percent(each['tip_inside'], 1)}: "
            f"in {percent(each['free_tip_inside'], 2)} of those in which the arm touches nothing "
            f"({percent(each['free'])} of all). Asked were 100 %, and {percent(LIMITED_SUCCESS)} success."
        )
    stops = sum(row["num_stops"] for row in rows.values())
    words.append(f"The bridge's safety stopped {stops} of {sum(row['num_goals'] for row in rows.values())} goals.")
    words.append(
        f"The bridge of all rows: {result['bridge']['set_points_per_step']} set-points a step, at most "
        f"{safety['max_speed_m_s']:g} m/s and {safety['max_acceleration_m_s2']:g} m/s2, "
        f"a grip of at most {safety['max_grip_force_n']:g} N.{measured_on(result['machine'])}"
    )
    return " ".join(words)


def _interval(each: Mapping[str, Any], name: str) -> str:
    return f"({percent(each[f'success_{name}_low'])} to {percent(each[f'success_{name}_high'])})"


if __name__ == "__main__":
    raise SystemExit(run_benchmark("transfer", __doc__, Settings, benchmark, transfer_table))
