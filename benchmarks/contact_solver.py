"""Time and grip of the contact solver, beside that of version 0.1, on the same states of a run that has learned.

    python -m benchmarks.contact_solver --run-dir runs/cube --json docs/results/contact_solver.json

Rounds are played with the newest policies of the run, from its newest checkpoint. Of the physics in them, a sample of
pairs of a state and a control is stepped by each solver in turn, on one thread. For the grip, the sampled states in
which both fingers hold the object in the air are held for some seconds more, at rest and with the gripper closing.
"""

from __future__ import annotations

import statistics
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from mujoco import rollout
from numpy.typing import NDArray

from benchmarks.measuring import describe_ratio, measure_in_turn, parser_of, rates, rates_table, ratio, run_benchmark
from benchmarks.rounds import Rounds, repeat_physics
from benchmarks.training_process import copy_run, scratch
from service.config import WorldConfig
from service.envs.batch import WorldBatch
from service.envs.objects import GRAVITY_MS2
from service.envs.scene import build_spec
from service.io.run_directory import RunDirectory
from service.runtime.local import LocalRun

TODAY = "today"
VERSION_0_1 = "version 0.1"
PACKAGES = ("mujoco", "numpy")
_HIGH_M = 0.08
"""Least height of an object's centre to count as held in the air."""
_LOST_MM = 20.0
"""An object that moves further in the gripper has slipped out, or was never held."""
_CLOSE = np.array([0.0, 0.0, 0.0, -1.0], dtype=np.float32)

StateArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Settings:
    """Amount of what is measured."""

    num_pairs: int = 9
    seconds: float = 2.0
    """Length of each measurement."""
    num_states: int = 1500
    hold_s: float = 5.0
    """How long held objects are held for the grip, seconds of robot time."""


class _RecordingBatch(WorldBatch):
    """Worlds that keep the states they step from, and their controls."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self.starts: list[StateArray] = []
        self.controls: list[StateArray] = []

    def _control(self, start: StateArray, *arguments: Any) -> StateArray:
        control = super()._control(start, *arguments)
        self.starts.append(start.copy())
        self.controls.append(control)
        return control


def build_model(config: WorldConfig, solver: str) -> mujoco.MjModel:
    """The world's model, with the contact solver and gravity of version 0.1 where ``solver`` says so.

    Its controls are the same: the object's weight keeps its actuator, without a force.
    """
    spec = build_spec(config)
    if solver == VERSION_0_1:
        spec.option.impratio, spec.option.noslip_iterations = 100.0, 0
        spec.option.gravity = (0, 0, -GRAVITY_MS2)
        for body in spec.bodies:
            body.gravcomp = float(body.name not in ("world", "object"))
        spec.actuator("object_weight").biasprm[0] = 0.0
    return spec.compile()


def record(source: RunDirectory, home: Path, num: int) -> tuple[WorldConfig, float, StateArray, StateArray]:
    """Play two rounds of a run; ``num`` of the (N, S) states stepped from and their (N, C) controls, drawn at random.

    Returns:
        Also the world, and the share of games with a blocked gripper.
    """
    copy = copy_run(source, home, "rounds")
    run = LocalRun(copy.read_config(), copy, resume=True)
    config, game = run.config.world, run.config.game
    rounds = Rounds(run)
    with _RecordingBatch(config, game.num_worlds, blocked_fraction=game.blocked_gripper_fraction) as worlds:
        for _ in range(2):
            rounds.play_and_repeat(0.0)
            repeat_physics(worlds, rounds.played[-1])
        states, controls = np.concatenate(worlds.starts), np.concatenate(worlds.controls)
    rounds.close()
    run.close()
    drawn = np.random.default_rng(0).choice(len(states), min(num, len(states)), replace=False)
    return config, game.blocked_gripper_fraction, states[drawn], controls[drawn]


def slip_m(config: WorldConfig, blocked_fraction: float, held: StateArray, solver: str, hold_s: float) -> StateArray:
    """(N,) greatest way of each object relative to the gripper while (N, S) states are held, metres."""
    with WorldBatch(config, len(held), blocked_fraction=blocked_fraction) as worlds:
        worlds.model = build_model(config, solver)
        worlds.restore(held)
        action = np.tile(_CLOSE, (len(held), 1))
        step_s = config.physics_step_s * config.num_substeps
        for _ in range(round(0.4 / step_s)):  # until the arm rests and the gripper has closed
            worlds.step(action)
        before = worlds.object_position - worlds.ee_position
        slip = np.zeros(len(held))
        for _ in range(round(hold_s / step_s)):
            worlds.step(action)
            slip = np.maximum(slip, np.linalg.norm(worlds.object_position - worlds.ee_position - before, axis=1))
    return slip


def compare(source: RunDirectory, home: Path, settings: Settings) -> dict[str, Any]:
    """Measure both solvers in turn, then their grip; for JSON."""
    config, blocked_fraction, states, controls = record(source, home, settings.num_states)
    with WorldBatch(config, 1, blocked_fraction=blocked_fraction) as worlds:
        layout = worlds.layout
    physics = np.ascontiguousarray(states[:, layout.physics])
    plays = {}
    for solver in (TODAY, VERSION_0_1):
        model = build_model(config, solver)
        plays[solver] = partial(_step_all, model, mujoco.MjData(model), physics, controls, config.num_substeps)
    samples = measure_in_turn(plays, settings.num_pairs, settings.seconds)
    in_air = states[:, layout["object"]][:, 2] > _HIGH_M
    held = states[in_air & (states[:, layout["contacts"]] > 0).all(axis=1)]
    slips = {
        solver: 1e3 * slip_m(config, blocked_fraction, held, solver, settings.hold_s)
        for solver in (plays if len(held) else ())
    }
    kept = np.all([each <= _LOST_MM for each in slips.values()], axis=0) & bool(slips)
    return {
        "rows": {name: rates(each) for name, each in samples.items()},
        "speed": ratio(samples[TODAY], samples[VERSION_0_1]),
        "cpu_ratio": statistics.median(
            b.steps_per_cpu_s / a.steps_per_cpu_s for a, b in zip(*samples.values(), strict=True)
        ),
        "num_states": len(states),
        "num_held": len(held),
        "lost_share": {name: float((each > _LOST_MM).mean()) for name, each in slips.items()},
        "slip_mm": {
            name: {"median": float(np.median(each[kept])), "p95": float(np.percentile(each[kept], 95))}
            for name, each in (slips.items() if kept.any() else ())
        },
    }


def _step_all(
    model: mujoco.MjModel, data: mujoco.MjData, states: StateArray, controls: StateArray, num_substeps: int
) -> int:
    rollout.rollout(model, data, states, controls[:, None, : model.nu], nstep=num_substeps)
    return len(states)


def report(result: Mapping[str, Any]) -> str:
    """What was measured, as Markdown."""
    lines = [rates_table(result["rows"]), "", describe_ratio(f"{TODAY} / {VERSION_0_1}", result["speed"])]
    lines.append(f"CPU time of {TODAY} / {VERSION_0_1}: {result['cpu_ratio']:.2f}")
    for name, slip in result["slip_mm"].items():
        numbers = ", ".join(f"{key} {value:.3f} mm" for key, value in slip.items())
        lines.append(
            f"{name}: of {result['num_held']} held objects {result['lost_share'][name]:.1%} lost, slip {numbers}"
        )
    return "\n".join(lines)


def main() -> int:
    """Run from a shell."""
    parser = parser_of(__doc__, Settings())
    parser.add_argument("--run-dir", type=Path, required=True, metavar="DIR", help="a run that has learned")
    given = parser.parse_args()
    with scratch() as home:
        benchmark: Callable[[Settings], dict[str, Any]] = partial(compare, RunDirectory(given.run_dir), home)
        return run_benchmark("contact_solver", PACKAGES, given, Settings, benchmark, report)


if __name__ == "__main__":
    sys.exit(main())
