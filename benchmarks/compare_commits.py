"""Env steps a second of the whole learning loop at two commits, measured in turn on the same cores.

    python -m benchmarks.compare_commits 10399f0 HEAD --json docs/results/throughput.json

Each commit is checked out into a worktree of its own and trains with its own shipped configuration for the same number
of env steps, since policies that touch the object make its physics dearer. From there a number of iterations is
measured, old, new, old, new, each time in a new process and from the same checkpoint: each repeats the same work bit
for bit, so what differs between them is the machine. Learning is part of it, and so are the evaluations, checkpoints
and records that fall into 20 iterations. Only the command line is used, which all commits have.
"""

from __future__ import annotations

import shutil
import subprocess
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.measuring import (
    RECIPE_FILE,
    ROOT,
    Sample,
    describe_ratio,
    parser_of,
    rates,
    rates_table,
    ratio,
    run_benchmark,
)
from benchmarks.training_process import ENDLESS, Training, copy_run, measure_training, overrides, scratch
from service.errors import TandemError
from service.io.run_directory import RunDirectory

PACKAGES = ("mujoco", "numpy", "torch")


@dataclass(frozen=True, slots=True)
class Settings:
    """Amount of what is measured."""

    trained_steps: int = 500_000
    """Env steps of training before the first measurement."""
    num_pairs: int = 5
    num_iterations: int = 20
    """Iterations of each measurement, with the evaluations and checkpoints that fall into them."""


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
    copy = copy_run(source, home)
    with Training(home, overrides(ENDLESS), runtime="local", tree=tree) as training:
        sample = measure_training(training, num_iterations).sample
    shutil.rmtree(copy.path)
    return sample


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


def benchmark(old: str, new: str, settings: Settings) -> dict[str, Any]:
    """Compare two commits in directories that are deleted at the end; the ratio is the new one's speed by the old's."""
    commits = [full_name(commit) for commit in (old, new)]
    if commits[0] == commits[1]:
        raise TandemError(f"{old} and {new} are the same commit; name two")
    names = [commit[:7] for commit in commits]
    with worktree(commits[0]) as before, worktree(commits[1]) as after, scratch() as home:
        samples = compare(dict(zip(names, (before, after), strict=True)), home, settings)
    return {
        "commits": {"old": commits[0], "new": commits[1]},
        "rows": {name: rates(each) for name, each in samples.items()},
        "ratio": ratio(samples[names[1]], samples[names[0]]),
    }


def report(result: dict[str, Any]) -> str:
    """A result for people."""
    return f"{rates_table(result['rows'])}\n{describe_ratio('new / old', result['ratio'])}"


def main() -> int:
    """Parse the command line, measure, print."""
    parser = parser_of(__doc__, Settings())
    parser.add_argument("old", metavar="OLD", help="a commit")
    parser.add_argument("new", metavar="NEW", nargs="?", default="HEAD", help="a later one (default: %(default)s)")
    given = parser.parse_args()
    return run_benchmark(
        "throughput", PACKAGES, given, Settings, lambda settings: benchmark(given.old, given.new, settings), report
    )


if __name__ == "__main__":
    raise SystemExit(main())
