"""Env steps a second at two commits, of self-play or of bare worlds, in turn on the same cores.

    python -m benchmarks.compare_commits 10399f0 HEAD --json docs/results/throughput.json
    python -m benchmarks.compare_commits 2b220b3^ HEAD --worlds --json docs/results/world_speed.json

Each commit is checked out into a worktree of its own and trains with its own shipped configuration for the same number
of env steps, since policies that touch the object make its physics dearer. From there a number of iterations is
measured, old, new, old, new, each time in a new process and from the same checkpoint: each repeats the same work bit
for bit, so what differs between them is the machine. Learning is part of it, and so are the evaluations, checkpoints
and records that fall into 20 iterations. Only the command line is used, which all commits have.

Bare worlds play episodes of random actions in the world of their commit's recipe, with one thread: what an actor does
but for its policies. With few worlds NumPy's calls weigh most, with many its arithmetic.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.measuring import (
    RECIPE_FILE,
    ROOT,
    Sample,
    describe_ratio,
    rates,
    rates_table,
    ratio,
    run_benchmark,
)
from benchmarks.training_process import ENDLESS, Training, environment, measure_copy, overrides, scratch
from service.base.errors import TandemError
from service.store.run_directory import RunDirectory

NUM_WORLDS = ("8", "240")
_PLAY_WORLDS = """
import json, sys
from dataclasses import asdict
from benchmarks.env_throughput import BatchContender
from benchmarks.measuring import RECIPE_FILE, measure
from service.config import load_config
play = BatchContender(load_config(RECIPE_FILE).world, int(sys.argv[1])).episode
play()
print(json.dumps(asdict(measure(play, float(sys.argv[2])))))
"""
"""What runs with the code of a commit."""


@dataclass(frozen=True, slots=True)
class Settings:
    """What is measured, and how much of it."""

    old: str
    """A commit."""
    new: str
    """A later one."""
    worlds: bool = False
    """Bare worlds, 8 and 240, not self-play."""
    trained_steps: int = 500_000
    """Env steps of training before the first measurement."""
    num_pairs: int = 5
    num_iterations: int = 20
    """Iterations of each measurement, with the evaluations and checkpoints that fall into them."""
    seconds: float = 2.0
    """Length of each measurement of bare worlds."""


@contextmanager
def worktree(commit: str, repository: Path = ROOT) -> Iterator[Path]:
    """The files of a commit in a directory that is there as long as the block is."""
    with tempfile.TemporaryDirectory() as above:
        path = Path(above) / "tree"
        _git(repository, "worktree", "add", "--quiet", "--detach", str(path), commit)
        try:
            yield path
        finally:
            _git(repository, "worktree", "remove", "--force", str(path))


def full_name(commit: str, repository: Path = ROOT) -> str:
    """The hash of a commit."""
    return _git(repository, "rev-parse", "--verify", f"{commit}^{{commit}}")


def _git(repository: Path, *arguments: str) -> str:
    try:
        result = subprocess.run(["git", "-C", str(repository), *arguments], capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError) as error:
        said = getattr(error, "stderr", None) or error
        words = " ".join(str(said).split())
        raise TandemError(f"git {arguments[0]} {arguments[-1]}: {words}; name a commit of this repository") from None
    return result.stdout.strip()


def train(tree: Path, home: Path, num_env_steps: int, config: Path) -> RunDirectory:
    """Train with the code of a checkout until ``num_env_steps`` are made, and save."""
    arguments = ["--config", str(config), *overrides(ENDLESS)]
    with Training(home, arguments, runtime="local", tree=tree) as training:
        training.wait_until("env_steps", num_env_steps)
        return training.directory


def measure_commit(tree: Path, source: RunDirectory, home: Path, num_iterations: int) -> Sample:
    """Go on from the newest checkpoint of ``source``, in a copy, with the code of a checkout."""
    return measure_copy(source, home, overrides(ENDLESS), num_iterations, runtime="local", tree=tree).sample


def compare(trees: Mapping[str, Path], home: Path, settings: Settings) -> dict[str, list[Sample]]:
    """Train with the code of every tree, checkouts by name, then measure all in turn; runs are below ``home``."""
    runs = {}
    for name, tree in trees.items():
        print(f"{name}: training for {settings.trained_steps:,} env steps", flush=True)
        runs[name] = train(tree, home / name, settings.trained_steps, tree / RECIPE_FILE.relative_to(ROOT))
    samples: dict[str, list[Sample]] = {name: [] for name in trees}
    for _ in range(settings.num_pairs):
        for name, tree in trees.items():
            samples[name].append(measure_commit(tree, runs[name], home, settings.num_iterations))
            print(f"{name}: {samples[name][-1].steps_per_s:,.0f} env steps/s", flush=True)
    return samples


def sample_of(program: str, tree: Path, home: Path, *arguments: object) -> Sample:
    """Run a program with the code of a checkout; the sample that it prints."""
    command = [sys.executable, "-c", program, *map(str, arguments)]
    done = subprocess.run(command, cwd=tree, env=environment(home, tree), capture_output=True, text=True, check=False)
    if done.returncode:
        raise TandemError(f"the code in {tree} cannot be measured: {' '.join(done.stderr.split()[-30:])}")
    return Sample(**json.loads(done.stdout.splitlines()[-1]))


def compare_programs(
    program: str, arguments: Sequence[str], trees: Mapping[str, Path], home: Path, settings: Settings
) -> dict[str, dict[str, list[Sample]]]:
    """Samples of a program in every tree in turn, by each of its arguments and by the name of the tree."""
    found: dict[str, dict[str, list[Sample]]] = {each: {name: [] for name in trees} for each in arguments}
    for each, samples in found.items():
        for _ in range(settings.num_pairs):
            for name, tree in trees.items():
                samples[name].append(sample_of(program, tree, home, each, settings.seconds))
    return found


def benchmark(settings: Settings) -> dict[str, Any]:
    """Compare two commits in directories that are deleted at the end; a ratio is the new one's speed by the old's."""
    commits = {"old": full_name(settings.old), "new": full_name(settings.new)}
    if commits["old"] == commits["new"]:
        raise TandemError(f"{settings.old} and {settings.new} are the same commit; name two")
    with worktree(commits["old"]) as before, worktree(commits["new"]) as after, scratch() as home:
        if settings.worlds:
            found = compare_programs(_PLAY_WORLDS, NUM_WORLDS, {"old": before, "new": after}, home, settings)
            rows = {num: {name: rates(each) for name, each in samples.items()} for num, samples in found.items()}
            ratios = {num: ratio(samples["new"], samples["old"]) for num, samples in found.items()}
            return {"benchmark": "world_speed", "commits": commits, "rows": rows, "ratios": ratios}
        first, last = names = [commit[:7] for commit in commits.values()]
        samples = compare(dict(zip(names, (before, after), strict=True)), home, settings)
    rows = {name: rates(each) for name, each in samples.items()}
    return {"commits": commits, "rows": rows, "ratio": ratio(samples[last], samples[first])}


def report(result: dict[str, Any]) -> str:
    """A result for people."""
    if "ratios" in result:
        return "\n".join(describe_ratio(f"new / old, {name}", each) for name, each in result["ratios"].items())
    return f"{rates_table(result['rows'])}\n{describe_ratio('new / old', result['ratio'])}"


if __name__ == "__main__":
    raise SystemExit(run_benchmark("throughput", __doc__, Settings, benchmark, report))
