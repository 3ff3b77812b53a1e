"""Env steps a second of a downstream worker that learns, at two commits, in turn on the same cores.

    python -m benchmarks.downstream_throughput 543176b --json FILE

The worker has its own settings: 64 worlds, several large updates after a step of all. Each sample is taken in a process
of its own, and the ratio of each turn counts.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Any

from benchmarks.compare_commits import full_name, sample_of, worktree
from benchmarks.measuring import ROOT, Sample, describe_ratio, parser_of, rates, rates_table, ratio, run_benchmark
from benchmarks.training_process import scratch
from service.downstream.learner import make_loop
from service.downstream.methods import METHODS
from service.downstream.settings import TrialConfig
from service.downstream.worker import make_worlds
from service.envs.tasks import EPISODE_STEPS
from service.primitives.loading import Trained

PACKAGES = ("torch", "mujoco")


@dataclass(frozen=True, slots=True)
class Settings:
    """Amount of what is measured, and of what."""

    task: str = "wall"
    method: str = "ours"
    """One that composes."""
    primitives: str = "panda-cube@champion"
    num_pairs: int = 5
    seconds: float = 20.0
    """Least length of each sample."""
    threads: int = 1
    """Threads of physics and torch."""


_MEASURE = """
import json, sys
from dataclasses import asdict
import torch
import service
from benchmarks import downstream_throughput as benchmark
from benchmarks.measuring import measure
from service.downstream.settings import make_trial
task, method, primitives, threads, seconds = sys.argv[1:]
torch.set_num_threads(int(threads))
trial, trained = make_trial(task=task, method=method), service.load_primitives(primitives, "no registry")
play = benchmark.make_worker(trial, trained, int(threads))
print(json.dumps(asdict(measure(play, float(seconds)))))
"""
"""Program that measures with the code of its own checkout; every commit since the first worker can run it."""


def make_worker(trial: TrialConfig, trained: Trained, num_threads: int) -> Callable[[], int]:
    """A function that plays an episode of every world, learning; it has begun to learn."""
    method = METHODS[trial.method]
    worlds = make_worlds(trial, method, trained, num_threads)
    loop, num = make_loop(trial, method, trained, worlds), EPISODE_STEPS * trial.sac.num_worlds
    loop.play(trial.sac.learning_starts + num)

    def play() -> int:
        before = loop.num_env_steps
        loop.play(num)
        return loop.num_env_steps - before

    return play


def benchmark(old: str, settings: Settings) -> dict[str, Any]:
    """The worker of a commit, and that of this checkout; the ratio is the new one's speed by the old's."""
    asked = (settings.task, settings.method, settings.primitives, settings.threads, settings.seconds)
    samples: dict[str, list[Sample]] = {"old": [], "new": []}
    with ExitStack() as stack:
        home, before = stack.enter_context(scratch()), stack.enter_context(worktree(full_name(old)))
        for _ in range(settings.num_pairs):
            for name, tree in {"old": before, "new": ROOT}.items():
                samples[name].append(sample_of(_MEASURE, tree, home, *asked))
    rows = {name: rates(each) for name, each in samples.items()}
    return {"rows": rows, "ratio": ratio(samples["new"], samples["old"])}


def report(result: dict[str, Any]) -> str:
    """A result for people."""
    return f"{rates_table(result['rows'])}\n{describe_ratio('new / old', result['ratio'])}"


def main() -> int:
    """Parse the command line, measure, print, write."""
    parser = parser_of(__doc__, Settings())
    parser.add_argument("old", metavar="OLD", help="a commit")
    given = parser.parse_args()
    return run_benchmark(
        "downstream_throughput", PACKAGES, given, Settings, lambda settings: benchmark(given.old, settings), report
    )


if __name__ == "__main__":
    raise SystemExit(main())
