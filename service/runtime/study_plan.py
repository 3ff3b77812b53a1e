"""The plan of a study: which seeds, how many runs at once, and with how many cores each."""

from __future__ import annotations

import re
from dataclasses import dataclass

from service.errors import ConfigError

CORES_PER_RUN = 2
"""A run on one machine plays on one core and learns on another."""
MAX_SEEDS = 1000


@dataclass(frozen=True, slots=True)
class Share:
    """Division of a machine, or a cluster, among the runs of a study."""

    num_parallel: int
    """Runs at once; the others wait for one of them to end."""
    num_workers: int
    """Workers of each that play: threads on one machine, rollout actors on a cluster."""


def parse_seeds(text: str) -> tuple[int, ...]:
    """Parse numbers and ranges, such as ``0,1,2`` or ``0-4,7``.

    Raises:
        ConfigError: something else, a seed given twice, or more than ``MAX_SEEDS``.
    """
    seeds: list[int] = []
    for part in text.split(","):
        match = re.fullmatch(r"([0-9]{1,9})(?:-([0-9]{1,9}))?", part.strip())
        if match is None:
            raise ConfigError(
                f"--seeds {text!r}: {part.strip()!r} is not a whole number from 0 on or a range; "
                "write for example 0,1,2 or 0-4"
            )
        first, last = int(match[1]), int(match[2] or match[1])
        if last < first:
            raise ConfigError(f"--seeds {text!r}: the range {part.strip()} goes down; write {last}-{first}")
        if len(seeds) + last - first >= MAX_SEEDS:
            raise ConfigError(f"--seeds {text!r}: more than {MAX_SEEDS} seeds; give fewer")
        seeds.extend(range(first, last + 1))
    twice = sorted({seed for seed in seeds if seeds.count(seed) > 1})
    if twice:
        raise ConfigError(f"--seeds {text!r}: {_listed(twice)} given twice; each seed is one run, so name it once")
    return tuple(seeds)


def check_same_seeds(given: tuple[int, ...], saved: tuple[int, ...]) -> None:
    """Check that a resumed study is given its own seeds, in whatever order.

    Raises:
        ConfigError: other ones.
    """
    if set(given) != set(saved):
        raise ConfigError(
            f"--seeds: the study has {_listed(saved)}, not {_listed(given)}; leave out --seeds to resume it, or begin "
            "another study with another --run-dir"
        )


def share_machine(num_cores: int, num_runs: int, parallel: int | None = None) -> Share:
    """Share one machine's cores out among runs.

    Args:
        num_cores: of the machine.
        num_runs: that are to be run, at least 1.
        parallel: how many of them at once; None: as many as have ``CORES_PER_RUN`` each.
    """
    num_parallel = min(num_runs, parallel or max(1, num_cores // CORES_PER_RUN))
    return Share(num_parallel, max(1, num_cores // num_parallel))


def share_cluster(
    num_cores: float,
    num_runs: int,
    parallel: int | None = None,
    *,
    num_actors: int | None = None,
    actor_threads: int = 1,
    learner_cpus: float = 0.0,
) -> Share:
    """Share a cluster's cores out among runs.

    Args:
        num_cores: of the cluster.
        num_runs: that are to be run, at least 1.
        parallel: how many of them at once; None: as many as have a core for each of their actors.
        num_actors: of each run; None: as many as its cores allow, at least 1.
        actor_threads: cores of each actor.
        learner_cpus: cores of a run that its learner has for itself.
    """
    least = (num_actors or 1) * actor_threads + learner_cpus
    num_parallel = min(num_runs, parallel or max(1, int(num_cores // least)))
    return Share(num_parallel, num_actors or max(1, int((num_cores / num_parallel - learner_cpus) // actor_threads)))


def _listed(seeds: tuple[int, ...] | list[int]) -> str:
    shown = ", ".join(map(str, sorted(seeds)[:10])) + (", ..." if len(seeds) > 10 else "")
    return f"seed {shown}" if len(seeds) == 1 else f"seeds {shown}"
