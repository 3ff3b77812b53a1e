"""What the runs of a study differ in: seeds, and settings of which each takes every value."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from itertools import product
from math import prod

import yaml

from service.base.errors import ConfigError

MAX_RUNS = 1000
MAX_NAME = 100
"""Characters of the name of a run, which is that of its directory, too."""
SEED = "seed"
PLAIN = ("task", "method", "recipe")
"""Settings whose values say what they are, so that their names are left out of a run's."""
Settings = dict[str, str]
"""The value of each key in one run."""


def parse_seeds(text: str) -> tuple[int, ...]:
    """Parse numbers and ranges, such as ``0,1,2`` or ``0-4,7``.

    Raises:
        ConfigError: something else, a seed given twice, or more than ``MAX_RUNS``.
    """
    seeds: list[int] = []
    for part in text.split(","):
        match = re.fullmatch(r"([0-9]{1,9})(?:-([0-9]{1,9}))?", part.strip())
        first, last = (int(match[1]), int(match[2] or match[1])) if match is not None else (0, -1)
        if last < first or len(seeds) + last - first >= MAX_RUNS:
            raise ConfigError(
                f"--seeds {text!r}: write whole numbers from 0 on and ranges, for example 0,1,2 or 0-4, of at most "
                f"{MAX_RUNS} seeds; {part.strip()!r} is none of them"
            )
        seeds.extend(range(first, last + 1))
    check_once(f"--seeds {text!r}", list(map(str, seeds)))
    return tuple(seeds)


def parse_grid(grids: Sequence[str], seeds: str | None = None) -> dict[str, list[str]]:
    """Parse ``KEY=V1,V2`` strings and seeds.

    A value is as in ``--set``; a comma in brackets or quotes is a part of its value.

    Raises:
        ConfigError: no key, no value, or a key or value that is given twice.
    """
    found: dict[str, list[str]] = {}
    for text in grids:
        key, separator, values = (part.strip() for part in text.partition("="))
        parts = _split(values)
        if not separator or not key or not parts:
            raise ConfigError(
                f"--grid {text!r}: expected KEY=VALUE,VALUE, for example learner.bob.learning_rate=1e-4,3e-4"
            )
        check_once(f"--grid {text!r}", parts)
        if key in found:
            raise ConfigError(f"--grid {text!r}: {key} is given by another --grid, too; write all its values in one")
        found[key] = parts
    if seeds is not None:
        if SEED in found:
            raise ConfigError(f"--seeds {seeds} and --grid {SEED}=...: give one of them")
        found[SEED] = list(map(str, parse_seeds(seeds)))
    return found


def check_once(option: str, values: Sequence[str]) -> None:
    """Check that no value is given twice.

    Raises:
        ConfigError: one is.
    """
    if twice := [value for value in dict.fromkeys(values) if values.count(value) > 1]:
        raise ConfigError(f"{option}: {', '.join(twice[:10])} given twice; name each once")


def name_runs(grid: Mapping[str, Sequence[str]]) -> dict[str, Settings]:
    """The settings of each run by its name, such as ``push-ours-seed-0``; empty for an empty grid.

    Raises:
        ConfigError: too many runs, or names too long or the same.
    """
    short = [key.rpartition(".")[2] for key in grid]
    labels = [name if short.count(name) == 1 else key for key, name in zip(grid, short, strict=True)]
    num_runs, runs = prod(map(len, grid.values())), dict[str, Settings]()
    if num_runs > MAX_RUNS:
        raise ConfigError(f"{num_runs} runs: a study has at most {MAX_RUNS}; give fewer values")
    for values in product(*grid.values()) if grid else ():
        parts = [value if label in PLAIN else f"{label}-{value}" for label, value in zip(labels, values, strict=True)]
        name = re.sub(r"[^A-Za-z0-9._-]+", "-", "-".join(parts)).strip("-.")
        if len(name) > MAX_NAME or name in runs:
            what = "is the name of two runs" if name in runs else f"is longer than {MAX_NAME} characters"
            raise ConfigError(f"{name} {what}: give fewer or shorter values to one study")
        runs[name] = dict(zip(grid, values, strict=True))
    return runs


def _split(text: str) -> list[str]:
    """The values of a list as they are typed, without the brackets around it; empty where it is none."""
    whole = f"[{text}]"
    try:
        node = yaml.compose(whole, Loader=yaml.SafeLoader)
    except (yaml.YAMLError, RecursionError):
        return []
    if not isinstance(node, yaml.SequenceNode) or text.endswith(","):
        return []
    return [whole[each.start_mark.index : each.end_mark.index] for each in node.value]
