"""How many env steps a second the whole learning loop makes at two commits, measured in turn on the same cores.

    python -m benchmarks.compare_commits 10399f0 HEAD --json docs/results/throughput.json

Each commit is checked out into a worktree of its own and trains with its own shipped configuration for the same number
of env steps, since policies that touch the object make its physics dearer. From there a number of iterations is
measured, old, new, old, new, each time in a new process and from the same checkpoint: each repeats the same work bit
for bit, so what differs between them is the machine. Learning is part of it, and so are the evaluations, checkpoints
and records that fall into 20 iterations.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.measuring import Sample, describe, describe_ratio, machine, rates, ratio, table, write_json
from service.errors import TandemError

ROOT = Path(__file__).parents[1]
PROBE = Path(__file__).parent / "loop_probe.py"
CONFIG = Path("configs") / "pretrain" / "panda_cube.yaml"
PACKAGES = ("mujoco", "numpy", "torch")


@dataclass(frozen=True, slots=True)
class Settings:
    """How much is measured."""

    trained_steps: int = 500_000
    """Env steps of training before the first measurement."""
    num_pairs: int = 5
    num_iterations: int = 20
    """Of each measurement; 20 hold one evaluation and one checkpoint, as the rest of a run does."""


@contextmanager
def worktree(commit: str, repository: Path = ROOT) -> Iterator[Path]:
    """The files of a commit in a directory that is there as long as the block is.

    Raises:
        TandemError: no such commit, or git cannot make the directory.
    """
    with tempfile.TemporaryDirectory() as scratch:
        path = Path(scratch) / "tree"
        _git(repository, "worktree", "add", "--quiet", "--detach", str(path), commit)
        try:
            yield path
        finally:
            _git(repository, "worktree", "remove", "--force", str(path))


def full_name(commit: str, repository: Path = ROOT) -> str:
    """The hash of a commit.

    Raises:
        TandemError: there is none of that name.
    """
    return _git(repository, "rev-parse", "--verify", f"{commit}^{{commit}}")


def _git(repository: Path, *arguments: str) -> str:
    try:
        result = subprocess.run(["git", "-C", str(repository), *arguments], capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError) as error:
        said = getattr(error, "stderr", None) or error
        words = " ".join(str(said).split())
        raise TandemError(f"git {arguments[0]} {arguments[-1]}: {words}; name a commit of this repository") from None
    return result.stdout.strip()


def compare(trees: Mapping[str, Path], scratch: Path, settings: Settings) -> dict[str, list[Sample]]:
    """Train with the code of every tree, then measure all in turn.

    Args:
        trees: checkouts by name.
        scratch: an empty directory for the runs.
        settings: how much.

    Raises:
        TandemError: a process failed.
    """
    for name, tree in trees.items():
        print(f"{name}: training for {settings.trained_steps:,} env steps", flush=True)
        probe(tree, "train", scratch / name, tree / CONFIG, settings.trained_steps)
    samples: dict[str, list[Sample]] = {name: [] for name in trees}
    for _ in range(settings.num_pairs):
        for name, tree in trees.items():
            copy = scratch / "copy"
            shutil.copytree(scratch / name, copy)
            taken = json.loads(probe(tree, "measure", copy, settings.num_iterations))
            shutil.rmtree(copy)
            samples[name].append(Sample(int(taken["num_steps"]), taken["wall_s"], taken["cpu_s"]))
            print(f"{name}: {samples[name][-1].steps_per_s:,.0f} env steps/s", flush=True)
    return samples


def probe(tree: Path, *arguments: object) -> str:
    """Run ``loop_probe.py`` with the code of a checkout, in a process of its own.

    Returns:
        The last line it printed.

    Raises:
        TandemError: it failed.
    """
    command = [sys.executable, str(PROBE), *map(str, arguments)]
    environment = {**os.environ, "PYTHONPATH": str(tree)}
    result = subprocess.run(command, cwd=tree, env=environment, capture_output=True, text=True)
    if result.returncode:
        last = (result.stderr.strip().splitlines() or ["no message"])[-1]
        raise TandemError(f"the learning loop of {tree.name} failed: {last}; try its commit by hand")
    return (result.stdout.strip().splitlines() or [""])[-1]


def benchmark(old: str, new: str, settings: Settings) -> dict[str, Any]:
    """Everything, in directories that are deleted at the end.

    Args:
        old: a commit.
        new: what it is compared with; the ratio is how many times as fast this one is.
        settings: how much.

    Raises:
        TandemError: no two commits, or a process failed.
    """
    commits = [full_name(commit) for commit in (old, new)]
    if commits[0] == commits[1]:
        raise TandemError(f"{old} and {new} are the same commit; name two")
    names = [commit[:7] for commit in commits]
    with worktree(commits[0]) as before, worktree(commits[1]) as after, tempfile.TemporaryDirectory() as scratch:
        samples = compare(dict(zip(names, (before, after), strict=True)), Path(scratch), settings)
    return {
        "commits": {"old": commits[0], "new": commits[1]},
        "rows": {name: rates(each) for name, each in samples.items()},
        "ratio": ratio(samples[names[1]], samples[names[0]]),
    }


def main() -> int:
    """Parse the command line, measure, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add, shown = parser.add_argument, Settings()
    add("old", metavar="OLD", help="a commit")
    add("new", metavar="NEW", nargs="?", default="HEAD", help="a later one (default: %(default)s)")
    add("--trained-steps", type=int, default=shown.trained_steps, help="before measuring (default: %(default)s)")
    add("--pairs", type=int, default=shown.num_pairs, help="measurements of each (default: %(default)s)")
    add("--iterations", type=int, default=shown.num_iterations, help="of each (default: %(default)s)")
    add("--json", type=Path, metavar="FILE", help="write everything measured")
    given = parser.parse_args()
    settings = Settings(given.trained_steps, given.pairs, given.iterations)
    try:
        where = machine(*PACKAGES)
        print(describe(where), flush=True)
        result = benchmark(given.old, given.new, settings)
        if given.json:
            head = {"benchmark": "throughput", "machine": where, "settings": asdict(settings)}
            write_json(given.json, head | result)
    except TandemError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(table(result["rows"]))
    print(describe_ratio("new / old", result["ratio"]))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
