"""Run directories and a registry, written by hand: nothing is trained for these tests."""

from __future__ import annotations

import json
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from service.base.intervals import wilson_interval
from service.base.version import LEARNING_VERSION
from service.registry.names import Version
from service.registry.registry import Registry
from service.store.models import ActorStatus, GoalCell, GoalGrid, RunStatus

TOKEN = "5f1d3c0a9b7e4826d1c0b5a4938271605f4e3d2c1b0a9988"
WRONG = "0000000000000000000000000000000000000000000000ff"
CLIENT: dict[str, Any] = {"trust_env": False, "timeout": 300.0, "verify": False}
"""Options of an HTTP client that asks this machine alone, without TLS, and waits where it is busy."""
VIDEO = bytes(range(256)) * 40
BEARER = {"Authorization": f"Bearer {TOKEN}"}


def status(run_id: str, **changes: Any) -> RunStatus:
    """The status of an active run with a heartbeat of now."""
    now = datetime.now(UTC)
    fields: dict[str, Any] = {
        "run_id": run_id,
        "name": "panda-cube",
        "runtime": "ray",
        "state": "running",
        "started": now,
        "heartbeat": now,
        "iteration": 3,
        "num_env_steps": 3000,
        "total_env_steps": 10_000,
        "env_steps_per_s": 500.0,
        "policy_version": 2,
        "policy_lag": 1.0,
        "num_rollouts_counted": 6,
        "num_rollouts_refused": 1,
        "totals": {
            "iterations": 4,
            "env_steps": 3900,
            "rollouts_counted": 6,
            "rollouts_refused": 1,
            "replacements": 3,
        },
        "actors": (
            ActorStatus(
                name="rollout-0", incarnation=2, num_replaced=2, state="alive", heartbeat=now, last_error="killed"
            ),
            ActorStatus(name="rollout-1", incarnation=0, state="starting", heartbeat=now),
            ActorStatus(name="learner", incarnation=1, num_replaced=1, state="alive", heartbeat=now),
        ),
    }
    return RunStatus(**(fields | changes))


def write_status(root: Path, run_id: str, **changes: Any) -> RunStatus:
    """Write a run, or its new status."""
    written = status(run_id, **changes)
    (root / run_id).mkdir(parents=True, exist_ok=True)
    (root / run_id / "status.json").write_text(written.model_dump_json())
    return written


def record(iteration: int, **values: float | None) -> dict[str, Any]:
    """The metrics of an iteration."""
    return {
        "iteration": iteration,
        "env_steps": 1000 * iteration,
        "alice/valid_fraction": 0.5,
        "alice/lifted_fraction": 0.25,
        "bob/success_rate": 0.125 * (iteration % 8),
        "time/learner_idle_fraction": 0.0625,
        **values,
    }


def append(root: Path, run_id: str, *records: dict[str, Any], file: str = "metrics.jsonl") -> None:
    """Append records as a run does."""
    with (root / run_id / file).open("a") as lines:
        lines.writelines(json.dumps(each) + "\n" for each in records)


def grid() -> GoalGrid:
    """A goal grid of two cells."""
    return GoalGrid(
        iteration=3,
        num_env_steps=3000,
        cell_size_m=0.05,
        shape=(7, 7, 7),
        num_cells=343,
        lower_m=(-0.2, -0.2, 0.0),
        upper_m=(0.1, 0.1, 0.3),
        cells=(
            GoalCell(center_m=(0.0, 0.0, 0.02), num_tries=9, success_rate=0.75, learnability=0.1875),
            GoalCell(center_m=(0.05, 0.0, 0.12), num_tries=0, success_rate=0.5, learnability=0.25),
        ),
    )


def write_runs(root: Path) -> None:
    """Write two runs: "cube" is active and has a goal grid, "old" has ended and has a video."""
    write_status(root, "old", state="finished", started=datetime(2026, 1, 1, tzinfo=UTC), actors=(), published="tiny@1")
    write_status(root, "cube")
    for run_id in ("old", "cube"):
        append(root, run_id, *(record(iteration) for iteration in (1, 2, 3)))
    (root / "cube" / "goals.json").write_text(grid().model_dump_json())
    goals = [[0, 0, 0.025, 0.01, 0.01, 0.03, 1], [0, 0, 0.025, 0.01, 0.01, 0.13, 0]]
    append(root, "cube", {"iteration": 3, "env_steps": 3000, "goals": goals}, file="goals.jsonl")
    (root / "old" / "rounds.mp4").write_bytes(VIDEO)
    (root / "old" / "curves.png").write_bytes(b"\x89PNG picture")


def write_trial(
    root: Path, run_id: str, task: str, method: str, seed: int, success: float | None, **changes: Any
) -> Path:
    """Write a run of two iterations that learns a task; it has ended where ``success``, over 300 episodes, is a number.

    Args:
        root: directory of runs.
        run_id: name of its directory.
        task: what it learns.
        method: how.
        seed: of the run.
        success: at the last step, in the final evaluation.
        changes: other keys of its configuration; ``total_env_steps`` is that of ``run``.
    """
    path, total = root / run_id, changes.pop("total_env_steps", 2000)
    scratch = method.startswith("scratch")
    tree = {"name": f"{task}-{method}", "seed": seed, "method": method, "task": task, "task_version": 1}
    tree |= {"primitives": "tiny@1", "primitives_digest": None if scratch else "0" * 64, "reward_margin_m": 0.01}
    tree |= {"world": {"object": "cube", "object_mass_kg": 0.1}, "run": {"total_env_steps": total, "num_threads": 0}}
    tree |= changes
    low, high = wilson_interval(round(300 * (success or 0.0)), 300)
    ended = {"success_last": success, "success_ever": 1.0, "num_episodes": 300}
    evaluation = {**ended, "success_last_low": low, "success_last_high": high} if success is not None else {}
    trial = {"task": task, "method": method, "seed": seed, "primitives_digest": tree["primitives_digest"]}
    trial |= {"primitives": None if scratch else tree["primitives"], "success": success, "success_ever": 1.0}
    trial |= {"success_low": low, "success_high": high, "num_episodes": 300} if evaluation else {}
    done: dict[str, Any] = {"iteration": 2, "num_env_steps": 2000, "total_env_steps": total, "actors": ()}
    state = "running" if success is None else "finished"
    write_status(root, run_id, name=f"{task}-{method}", runtime="local", state=state, trial=trial, **done)
    (path / "config.yaml").write_text(json.dumps(tree))  # JSON is YAML
    names = {"rollout/success_last": 0.25, "evaluation/success_last": success, "time/env_steps_per_s": 50.0}
    append(root, run_id, *({"iteration": i, "env_steps": 1000 * i, **names} for i in (1, 2)))
    if evaluation:
        result = {
            "evaluation": evaluation,
            "made": {"learning_version": LEARNING_VERSION},
            "env_steps": total,
            "wall_s": 9.0,
        }
        (path / "result.json").write_text(json.dumps(result))
    return path


def publish(registry: Registry, name: str = "tiny", value: float = 0.0, **spaces: Any) -> Version:
    """Publish a small version, with more ``spaces``."""
    return registry.publish(
        name,
        {"gate.weight": np.full((2, 3), value, np.float32)},
        spaces={"action": 4, **spaces},
        normalisation={"offset": [0.0]},
        config={"seed": 3},
        metrics={"evaluation/mixed_success_last": 0.5},
    )
