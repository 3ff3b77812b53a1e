"""Whether two commits learn the same bits: small trainings with the code of both, compared number by number.

    python -m benchmarks.same_bits --old f0b7427 --json same_bits.json

The trainings run on this machine with this Python, one after the other, on one thread each. Compared are all arrays and
plain values of the last checkpoint, the goals, and all metrics but ``time/*``. The exit code is 1 if anything differs
or a training fails. To see that it finds a difference, change one number of this checkout:

    sed -i 's/^MEMORY_TRIES = 30.0$/MEMORY_TRIES = 31.0/' service/generator/difficulty.py
    python -m benchmarks.same_bits --only self-play

``ROWS`` says what is run, by commands that both commits take. What 4dacdca learned was compared by this program of
f0b7427, which knew the names of before.
"""

from __future__ import annotations

import json
import os
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path
from typing import Any

from safetensors import safe_open

from benchmarks.compare_commits import full_name, worktree
from benchmarks.measuring import ROOT, run_benchmark
from benchmarks.processes import descendants
from benchmarks.training_process import Records, environment, scratch
from service.base.errors import TandemError
from service.base.markdown import table

WORKTREE = "worktree"
NOT_LEARNED = frozenset({"config", "format_version", "records", "run", "sha256", "wall_s"})
"""Keys of those plain values that say how, when and where; they may differ."""
METRICS, GOALS, CHECKPOINTS = "metrics.jsonl", "goals.jsonl", "checkpoints"
NUM_SHOWN = 4
_LOOK_S = 0.005
Values = list[tuple[int, object]]
"""The number of a record, 0 in a checkpoint, and what stands for the value."""


@dataclass(frozen=True, slots=True)
class Row:
    """A training, by the arguments of ``tandem``."""

    name: str
    command: str
    """``{run}`` stands for the run directory, ``{registry}`` for a registry without versions."""
    killed_after: int = 0
    """Iteration of the checkpoint from which it is resumed after a kill -9; 0: it is not killed."""
    late: tuple[str, ...] = ()
    """Beginnings of metrics that come with the next record there is: their values count, not where they are."""


_PRETRAIN = "pretrain --run-dir {run} --registry {registry} --no-publish --quiet --set seed=3 --set run.num_threads=1"
_SELF_PLAY = (
    f"{_PRETRAIN} --set run.total_env_steps=20000 --set run.checkpoint_interval=12 --set run.evaluation_interval=8"
    " --set run.evaluation_episodes=20 --set game.num_worlds=24 --set game.bob_margin_after_updates=6"
    " --set game.blocked_gripper_min_success=0 --set generator.opponent_interval=2"
    " --set learner.alice.minibatch_size=256"
)
_RAY = f"{_SELF_PLAY} --set run.total_env_steps=20600 --runtime ray --num-actors 1 --status off"
_ROBUST = (
    f"{_PRETRAIN} --config panda-cube-robust --from panda-cube@champion --set run.total_env_steps=6000"
    " --set run.evaluation_interval=3 --set run.evaluation_episodes=20 --set distillation.num_worlds=24"
    " --set distillation.gradient_steps=8 --set distillation.batch_size=256"
)
_SKILLS = (
    f"{_PRETRAIN} --set run.total_env_steps=9600 --set run.evaluation_interval=3 --set skills.sac.num_worlds=32"
    " --set skills.sac.learning_starts=1600 --set skills.replay_steps=6400"
)
_TASK = (
    "train wall --primitives panda-cube@champion --run-dir {run} --registry {registry} --quiet"
    " --set run.total_env_steps=12800 --set run.final_episodes=20 --set run.num_threads=1"
)
_LEARNERS = ("ours", "ours-her", "ours-residual-her", *(f"scratch-{net}" for net in ("monolithic", "mcp")))
_LEARNERS += tuple(f"scratch-{net}-her" for net in ("monolithic", "mcp"))
ROWS = (
    Row("self-play", _SELF_PLAY, killed_after=12),
    Row("self-play-ray", _RAY, killed_after=12, late=("evaluation/",)),  # its actor evaluates beside the updates
    Row("distillation", _ROBUST),
    *(Row(method, f"{_SKILLS} --method {method}") for method in ("lsd", "metra", "dads", "diayn")),
    *(Row(f"wall-{method}", f"{_TASK} --method {method}") for method in _LEARNERS),
)


@dataclass(frozen=True, slots=True)
class Settings:
    """What is compared."""

    old: str = "HEAD"
    """A commit."""
    new: str = WORKTREE
    """A commit, or this checkout as it is."""
    only: str = ""
    """Names of rows, with commas; empty: all."""


# --- comparing --------------------------------------------------------------------------------------------------------


def compare_runs(old: Path, new: Path, row: Row) -> dict[str, Any]:
    """Compare what two run directories of a row hold: how much that was, and the names of what differs."""
    before, after = read_run(old, row), read_run(new, row)
    names = before.keys() & after.keys()
    differing = [
        (_first_difference(before.get(name, []), after.get(name, [])), name)
        for name in before.keys() | after.keys()
        if before.get(name) != after.get(name)
    ]
    return {
        "num_arrays": sum(name.startswith("checkpoint/") for name in names),
        "num_records": sum(min(len(before[name]), len(after[name])) for name in names if name.endswith("/iteration")),
        "differing": [f"{name} from record {number} on" if number else name for number, name in sorted(differing)],
    }


def _first_difference(one: Values, other: Values) -> int:
    """Number of the first record that differs; 0 where records have no part in it."""
    pairs = zip_longest(one, other, fillvalue=(sys.maxsize, None))
    return next((min(a[0], b[0]) for a, b in pairs if a != b), 0)


def newest_checkpoint(directory: Path) -> Path:
    """The last file of the last process."""
    if not (files := sorted(directory.glob("*.safetensors"))):
        raise TandemError(f"no checkpoint in {directory}")
    return files[-1]


def read_run(run: Path, row: Row) -> dict[str, Values]:
    """Everything that is compared, by name.

    Names are ``checkpoint/ARRAY``, ``header/KEY`` for the plain values beside the arrays, and ``FILE.jsonl/METRIC``.
    """
    found: dict[str, Values] = {}
    with safe_open(newest_checkpoint(run / CHECKPOINTS), "numpy") as opened:
        for name in opened.keys():  # noqa: SIM118
            array = opened.get_tensor(name)
            found[f"checkpoint/{name}"] = [(0, (array.dtype.str, array.shape, array.tobytes()))]
        for header in (opened.metadata() or {}).values():
            found |= {name: [(0, text)] for name, text in _leaves("header", json.loads(header))}
    for file in (run / METRICS, *run.glob(GOALS)):  # not every training has goals
        for number, line in enumerate(file.read_text("utf-8").splitlines(), 1):
            for key, value in json.loads(line).items():
                if not key.startswith("time/"):
                    # as text, 0.0 and -0.0 differ, and so do 1 and 1.0
                    pair = 0 if key.startswith(row.late) else number, json.dumps(value)
                    found.setdefault(f"{file.name}/{key}", []).append(pair)
    return found


def _leaves(name: str, value: Any) -> Iterator[tuple[str, str]]:
    if isinstance(value, list):
        value = dict(enumerate(value))
    if not isinstance(value, dict):
        yield name, json.dumps(value)
        return
    for key, each in value.items():
        if key not in NOT_LEARNED:
            yield from _leaves(f"{name}/{key}", each)


# --- running ----------------------------------------------------------------------------------------------------------


def train(row: Row, tree: Path, home: Path) -> Path:
    """Run a row with the code of a checkout; its run directory."""
    run = home / "runs" / row.name
    command = shlex.split(row.command.format(run=run, registry=home / "registry"))
    if row.killed_after:
        records = Records(run / METRICS)
        _run(command, tree, home, lambda: any(each["iteration"] > row.killed_after for each in records.new()))
        newest = newest_checkpoint(run / CHECKPOINTS)
        if not newest.stem.endswith(f"{row.killed_after:08d}"):
            raise TandemError(f"killed too late, after {newest.name} was saved; try again when less else runs here")
        command.append("--resume")
    _run(command, tree, home)
    return run


def _run(command: Sequence[str], tree: Path, home: Path, kill: Callable[[], bool] = lambda: False) -> None:
    """Run ``tandem`` with the code of a checkout to its end, or until ``kill`` says to kill it and all below it."""
    home.mkdir(parents=True, exist_ok=True)
    variables = environment(home, tree) | {"OMP_NUM_THREADS": "1", "MUJOCO_GL": "disable"}  # no videos at the end
    with (home / "log").open("wb") as log:
        process = subprocess.Popen(
            [sys.executable, "-m", "service", *command], cwd=tree, env=variables,
            stdin=subprocess.DEVNULL, stdout=log, stderr=log,
        )  # fmt: skip
    try:
        while process.poll() is None and not kill():
            time.sleep(_LOOK_S)
        code = process.returncode
    finally:
        for pid in descendants(process.pid) if process.poll() is None else ():
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        process.wait()
    if code:
        words = " ".join((home / "log").read_text(encoding="utf-8", errors="replace").split()[-40:])
        raise TandemError(f"tandem {command[0]} ended with code {code}: {words or 'no message'}")


def benchmark(settings: Settings) -> dict[str, Any]:
    """Run and compare rows in directories that are deleted at the end."""
    chosen = {row.name: row for row in ROWS if not settings.only or row.name in settings.only.split(",")}
    if unknown := set(filter(None, settings.only.split(","))) - chosen.keys():
        raise TandemError(f"--only {min(unknown)}: choose from {', '.join(row.name for row in ROWS)}")
    rows: dict[str, dict[str, Any]] = {}
    with ExitStack() as stack:
        old = stack.enter_context(worktree(full_name(settings.old)))
        new = ROOT if settings.new == WORKTREE else stack.enter_context(worktree(full_name(settings.new)))
        home = stack.enter_context(scratch())
        for name, row in chosen.items():
            begun = time.monotonic()
            try:
                before, after = train(row, old, home / "old"), train(row, new, home / "new")
                rows[name] = compare_runs(before, after, row)
            except (TandemError, OSError) as error:  # other rows may say more
                rows[name] = {"num_arrays": 0, "num_records": 0, "differing": [f"failed: {error}"]}
            rows[name]["seconds"] = round(time.monotonic() - begun, 1)
            print(f"{name}: {len(rows[name]['differing'])} differ, {rows[name]['seconds']:.0f} s", flush=True)
    return {"rows": rows}


def report(result: dict[str, Any]) -> str:
    """A result for people."""
    cells = []
    for name, row in result["rows"].items():
        what, num_more = ", ".join(row["differing"][:NUM_SHOWN]), len(row["differing"]) - NUM_SHOWN
        what += f" and {num_more} more" if num_more > 0 else ""
        numbers = (str(row[key]) for key in ("num_arrays", "num_records"))
        cells.append((name, *numbers, what or "nothing", f"{row['seconds']:.0f}"))
    return table(("", "arrays compared", "records compared", "differing", "seconds"), cells)


def differs(result: dict[str, Any]) -> bool:
    """Whether anything does."""
    return any(row["differing"] for row in result["rows"].values())


if __name__ == "__main__":
    raise SystemExit(run_benchmark("same_bits", __doc__, Settings, benchmark, report, differs))
