"""What self-play costs on top of its physics: the bare world, rounds with policies, and the whole loop, in turn.

All three make physics of the same kind. Some iterations of the whole loop, learning included, are followed by rounds
without learning under the newest policies. After each round the bare world starts from the states of that round and
repeats its actions, bit for bit, because an arm that touches nothing is faster. Beside it stands the same batch under
random actions, every world always acting.

With ``--run-dir`` all of it goes on from the newest checkpoint of that run, in a copy: its policies have learned to
touch the object.
"""

from __future__ import annotations

import argparse
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

# before NumPy is imported: as the command line does
os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"))
sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.measuring import (
    Sample,
    Stopwatch,
    describe,
    describe_ratio,
    machine,
    rates,
    ratio,
    table,
    total,
    write_json,
)
from benchmarks.rounds import Rounds
from service.config import Config, dump_config, load_config
from service.errors import TandemError
from service.io.checkpoints import CheckpointStore
from service.io.jsonl import read_jsonl
from service.io.run_directory import RunDirectory
from service.runtime.local import LocalRun
from service.runtime.pretrain import resumed_config
from service.runtime.timing import Timing

ROOT = Path(__file__).parents[1]
BARE = "bare world"
BARE_RANDOM = "bare world, random actions"
ROLLOUT = "rollout with policies"
LOOP = "whole loop"
ROWS = (BARE, BARE_RANDOM, ROLLOUT, LOOP)
PACKAGES = ("mujoco", "numpy", "torch")
START_TIMEOUT_S = 180.0
_ENDLESS = "run.total_env_steps=1000000000000"


@dataclass(frozen=True, slots=True)
class Settings:
    """How much is measured."""

    num_pairs: int = 5
    seconds: float = 12.0
    """Of each measurement of rounds and, after each round, its physics; half as long for random actions."""
    num_iterations: int = 20
    """Of each measurement of the whole loop; 20 hold one evaluation and one checkpoint, as the rest of a run does."""
    num_warmup_iterations: int = 12
    """Iterations before the first measurement, at least 1; past opponents play from the 12th on."""


class Comparison:
    """Interrupts a run between iterations to measure the other two beside it."""

    def __init__(self, run: LocalRun, settings: Settings) -> None:
        self._run, self._settings = run, settings
        self._rounds = Rounds(run)
        self._warmup_left = max(settings.num_warmup_iterations, 1)
        self._watch, self._first_step, self._left = Stopwatch(), 0, 0
        self._lags: list[float] = []
        self._learn_s = 0.0
        self._contact: list[float] = []
        self._loop_timing: dict[str, float] = {}
        self.samples: dict[str, list[Sample]] = {name: [] for name in ROWS}

    def close(self) -> None:
        """Free the worlds."""
        self._rounds.close()

    def on_iteration(self, metrics: dict[str, float]) -> None:
        """For ``LocalRun.run``, which calls it while its learner waits."""
        if self._warmup_left > 0:
            self._warmup_left -= 1
            if self._warmup_left == 0:
                self._run.timing = Timing()
                self._begin()
            return
        self._lags.append(metrics["learner/policy_lag"])
        self._learn_s += metrics["time/learn_s"]
        self._left -= 1
        if self._left == 0:
            self.samples[LOOP].append(self._watch.sample(self._run.num_env_steps - self._first_step))
            self._measure_others()
            self._begin()

    def result(self) -> dict[str, Any]:
        """Everything measured, for JSON."""
        loop_s = sum(sample.wall_s for sample in self.samples[LOOP])
        return {
            "rows": {name: rates(each) for name, each in self.samples.items()},
            "ratios": {
                f"{ours} / {theirs}": ratio(self.samples[ours], self.samples[theirs])
                for ours in (ROLLOUT, LOOP)
                for theirs in (BARE, BARE_RANDOM)
            },
            "learner_idle_share": 1.0 - self._learn_s / loop_s,
            "policy_lag": {"mean": statistics.fmean(self._lags), "max": max(self._lags)},
            "alice_contact_fraction": statistics.fmean(self._contact),
            "timing": {"rollout": self._rollout_timing(), "loop": {"total": loop_s, **self._loop_timing}},
        }

    def _begin(self) -> None:
        self._watch, self._first_step = Stopwatch(), self._run.num_env_steps
        self._left = self._settings.num_iterations

    def _measure_others(self) -> None:
        watch, seconds = Stopwatch(), self._settings.seconds
        self._loop_timing = dict(self._run.timing.seconds)
        whole, bare = self._rounds.play_and_repeat(seconds)
        self.samples[ROLLOUT].append(whole)
        self.samples[BARE].append(bare)
        self.samples[BARE_RANDOM].append(self._rounds.act_at_random(seconds / 2))
        self._contact += [each.rollout.metrics["alice/contact_fraction"] for each in self._rounds.played]
        if len(self.samples[LOOP]) == self._settings.num_pairs:
            self._run.request_stop()
        self._run.timing.seconds["record"] -= watch.wall_s()  # this is called within that section

    def _rollout_timing(self) -> dict[str, float]:
        """Seconds of all rounds; those of their physics are what repeating it took."""
        whole, bare = total(self.samples[ROLLOUT]), total(self.samples[BARE])
        return {"total": whole.wall_s, "physics": bare.wall_s, **self._rounds.timing.seconds}


def compare(config: Config, directory: Path, settings: Settings, *, resume: bool = False) -> dict[str, Any]:
    """Run a pre-training in ``directory`` for as long as it takes to measure everything."""
    run = LocalRun(config, RunDirectory(directory), resume=resume)
    comparison = Comparison(run, settings)
    try:
        run.run(comparison.on_iteration)
    finally:
        comparison.close()
        run.directory.close()
    return comparison.result()


def first_update_s(config: Config, directory: Path) -> float:
    """Seconds from starting ``tandem pretrain`` anew to the end of its first update.

    Raises:
        TandemError: it ended before that, or took over three minutes.
    """
    directory.mkdir(parents=True)
    config_file, run_dir = directory / "config.yaml", directory / "run"
    config_file.write_text(dump_config(config))
    command = [sys.executable, "-m", "service", "pretrain", "--config", str(config_file), "--run-dir", str(run_dir)]
    watch = Stopwatch()
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.DEVNULL) as process:
        try:
            while not _has_learned(run_dir):
                if process.poll() is not None or watch.wall_s() > START_TIMEOUT_S:
                    raise TandemError(f"`tandem pretrain` made no update in {watch.wall_s():.0f} s; see what it said")
                time.sleep(0.02)
            return watch.wall_s()
        finally:
            process.kill()


def _has_learned(run_dir: Path) -> bool:
    metrics_file = RunDirectory(run_dir).metrics_file
    return metrics_file.exists() and any("learner/version" in each for each in read_jsonl(metrics_file))


def copy_run(source: RunDirectory, target: Path) -> Config:
    """Copy what ``source`` needs to be resumed elsewhere; its configuration, with an endless budget.

    Raises:
        TandemError: no run there, or one without a checkpoint.
    """
    config = resumed_config(source, [_ENDLESS])
    store = CheckpointStore(source.checkpoints, keep=1)
    if not store.steps():
        raise TandemError(f"no checkpoint in {source.checkpoints}; name a run that has one")
    newest = store.path(store.steps()[-1])
    copies = RunDirectory(target).checkpoints
    copies.mkdir(parents=True)
    shutil.copy(newest, copies)
    return config


def tree(seconds: dict[str, float]) -> str:
    """``total`` and its parts as lines; ``other`` is what no part accounts for."""
    parts = {name: spent for name, spent in seconds.items() if name != "total"}
    parts["other"] = seconds["total"] - sum(parts.values())
    lines = [f"  {name:<18}{spent:8.1f} s {100 * spent / seconds['total']:5.1f} %" for name, spent in parts.items()]
    return "\n".join([f"{'total':<20}{seconds['total']:8.1f} s", *lines])


def report(result: dict[str, Any]) -> str:
    """A result for people."""
    lines = [table(result["rows"])]
    lines += [describe_ratio(name, each) for name, each in result["ratios"].items()]
    lag = result["policy_lag"]
    lines += [
        f"learner idle: {result['learner_idle_share']:.1%} of the whole loop",
        f"policy lag: mean {lag['mean']:.2f}, max {lag['max']:.0f}",
        f"start to first update: {result['start_to_first_update_s']:.1f} s",
        f"Alice touched the object in {result['alice_contact_fraction']:.0%} of her turns",
    ]
    lines += [f"\n{name}:\n{tree(seconds)}" for name, seconds in result["timing"].items()]
    return "\n".join(lines)


def benchmark(config: Config, run_dir: Path | None, settings: Settings) -> dict[str, Any]:
    """Everything, in a directory of its own that is deleted at the end."""
    with tempfile.TemporaryDirectory() as scratch:
        directory = Path(scratch) / "run"
        if run_dir is not None:
            config = copy_run(RunDirectory(run_dir), directory)
        result = compare(config, directory, settings, resume=run_dir is not None)
        return {**result, "start_to_first_update_s": first_update_s(config, Path(scratch) / "start")}


def main() -> int:
    """Parse the command line, measure, print."""
    given = _parser().parse_args()
    settings = Settings(given.pairs, given.seconds, given.iterations, given.warmup)
    try:
        where = machine(*PACKAGES)
        print(describe(where), flush=True)
        result = benchmark(load_config(given.config, [_ENDLESS]), given.run_dir, settings)
        if given.json:
            head = {"benchmark": "selfplay_throughput", "machine": where, "settings": asdict(settings)}
            write_json(given.json, head | result)
    except TandemError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(report(result))
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add, shown = parser.add_argument, Settings()
    add("--config", type=Path, metavar="FILE", default=ROOT / "configs" / "pretrain" / "panda_cube.yaml")
    add("--run-dir", type=Path, metavar="DIR", help="go on from this run, with its configuration")
    add("--pairs", type=int, default=shown.num_pairs, help="measurements of each (default: %(default)s)")
    add("--seconds", type=float, default=shown.seconds, help="of rounds and their physics (default: %(default)s)")
    add("--iterations", type=int, default=shown.num_iterations, help="of the whole loop (default: %(default)s)")
    add("--warmup", type=int, default=shown.num_warmup_iterations, help="iterations, at least 1 (default: %(default)s)")
    add("--json", type=Path, metavar="FILE", help="write everything measured")
    return parser


if __name__ == "__main__":
    raise SystemExit(main())
