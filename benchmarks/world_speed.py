"""Env steps a second of the bare worlds at two commits, measured in turn, each in a process of its own.

    python -m benchmarks.world_speed 2b220b3^ HEAD --json docs/results/world_speed.json

Each commit is checked out into a worktree and plays episodes of random actions in the world of its own recipe, with one
thread: what an actor does but for its policies. Few worlds an actor are what makes runs short, and there NumPy's calls
weigh most; with many, its arithmetic. ``compare_commits`` is for the whole learning loop.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

from benchmarks.compare_commits import full_name, worktree
from benchmarks.measuring import Sample, describe_ratio, parser_of, rates, ratio, run_benchmark
from service.errors import TandemError

PACKAGES = ("mujoco", "numpy")
NUM_WORLDS = (8, 240)
_PLAYER = """
import json, sys
from benchmarks.env_throughput import BatchContender
from benchmarks.measuring import RECIPE_FILE, measure
from service.config import load_config

world = load_config(RECIPE_FILE).world
rows = {}
for line in sys.stdin:
    num_worlds, seconds = json.loads(line)
    if num_worlds not in rows:
        rows[num_worlds] = BatchContender(world, num_worlds)
    sample = measure(rows[num_worlds].episode, seconds)
    print(json.dumps([sample.num_steps, sample.wall_s, sample.cpu_s]), flush=True)
"""
"""What runs with the code of a commit: for every line with a number of worlds and seconds, a line with a sample."""


@dataclass(frozen=True, slots=True)
class Settings:
    """Amount of what is measured."""

    num_pairs: int = 7
    seconds: float = 2.0
    """Length of each measurement."""


class Player:
    """A process that plays with the code of a checkout when it is asked to."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        assert process.stdin is not None
        assert process.stdout is not None
        self._process = process
        self._questions: IO[str] = process.stdin
        self._answers: IO[str] = process.stdout

    def measure(self, num_worlds: int, seconds: float) -> Sample:
        """Play for about so long.

        Raises:
            TandemError: the process has failed.
        """
        try:
            print(json.dumps([num_worlds, seconds]), file=self._questions, flush=True)
        except BrokenPipeError:
            answer = ""
        else:
            answer = self._answers.readline()
        if not answer:
            self._process.wait()
            raise TandemError(f"a commit's worlds cannot be played: exit code {self._process.returncode}, see above")
        return Sample(*json.loads(answer))


@contextmanager
def player(tree: Path) -> Iterator[Player]:
    """A process with the code of a checkout, which is there as long as the block is."""
    environment = os.environ | {"PYTHONPATH": str(tree), "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    command = [sys.executable, "-c", _PLAYER]
    with subprocess.Popen(
        command, cwd=tree, env=environment, text=True, stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as process:
        yield Player(process)  # it ends when its input does, which the end of the block closes


def compare(trees: Sequence[Path], settings: Settings) -> dict[str, tuple[list[Sample], list[Sample]]]:
    """Samples of the code of two checkouts in turn, by the number of worlds, after one each to warm up."""
    with ExitStack() as stack:
        players = [stack.enter_context(player(tree)) for tree in trees]
        found: dict[str, tuple[list[Sample], list[Sample]]] = {}
        for num in NUM_WORLDS:
            samples: tuple[list[Sample], list[Sample]] = ([], [])
            for each in players:
                each.measure(num, 0.0)
            for _ in range(settings.num_pairs):
                for own, each in zip(samples, players, strict=True):
                    own.append(each.measure(num, settings.seconds))
            found[str(num)] = samples
    return found


def benchmark(old: str, new: str, settings: Settings) -> dict[str, Any]:
    """Compare two commits; the ratios are the new one's speed by the old's, by the number of worlds."""
    commits = {"old": full_name(old), "new": full_name(new)}
    with worktree(commits["old"]) as before, worktree(commits["new"]) as after:
        samples = compare((before, after), settings)
    return {
        "commits": commits,
        "rows": {num: {"old": rates(old), "new": rates(new)} for num, (old, new) in samples.items()},
        "ratios": {num: ratio(new, old) for num, (old, new) in samples.items()},
    }


def report(result: dict[str, Any]) -> str:
    """A result for people."""
    return "\n".join(describe_ratio(f"new / old, {num} worlds", each) for num, each in result["ratios"].items())


def main() -> int:
    """Parse the command line, measure, print."""
    parser = parser_of(__doc__, Settings())
    parser.add_argument("old", metavar="OLD", help="a commit")
    parser.add_argument("new", metavar="NEW", nargs="?", default="HEAD", help="a later one (default: %(default)s)")
    given = parser.parse_args()
    return run_benchmark(
        "world_speed", PACKAGES, given, Settings, lambda settings: benchmark(given.old, given.new, settings), report
    )


if __name__ == "__main__":
    raise SystemExit(main())
