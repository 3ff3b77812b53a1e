"""Tools that all benchmarks share: samples taken in turn, their ratios, the machine, and one command line.

A rate alone says little where others use the machine, too. So what is compared is measured in turn within one run, and
the ratio of each turn is what counts. Functions of benchmarks raise ``TandemError`` where a run, a file or a program
that they need is not there or fails; ``run_benchmark`` prints its one line.
"""

from __future__ import annotations

import argparse
import functools
import importlib.metadata
import json
import os
import platform
import re
import statistics
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import MISSING, asdict, dataclass, fields
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

from service.base.errors import TandemError
from service.base.files import write_atomic
from service.base.markdown import table
from service.base.version import git_commit

ROOT = Path(__file__).parents[1]
RECIPE_FILE = ROOT / "configs" / "pretrain" / "panda_cube.yaml"
PACKAGES = ("mujoco", "numpy", "torch", "gymnasium", "ray", "redis", "panda-gym", "pybullet")
"""Those on which measurements may depend."""
_PLAIN_LIST = re.compile(r"\[[^\[\]{}]*\]")
_Settings = TypeVar("_Settings")
_Arguments = ParamSpec("_Arguments")


def one_line_errors(main: Callable[_Arguments, int]) -> Callable[_Arguments, int]:
    """A program that prints the one line of an error that a user can correct, and then ends with 2."""

    @functools.wraps(main)
    def program(*args: _Arguments.args, **kwargs: _Arguments.kwargs) -> int:
        try:
            return main(*args, **kwargs)
        except TandemError as error:
            print(f"error: {error}", file=sys.stderr)
            return 2

    return program


@dataclass(frozen=True, slots=True)
class Sample:
    """Env steps made in one stretch of time."""

    num_steps: int
    wall_s: float
    cpu_s: float
    """CPU seconds of all threads and processes together."""

    @property
    def steps_per_s(self) -> float:
        """Env steps per wall-clock second."""
        return self.num_steps / self.wall_s

    @property
    def steps_per_cpu_s(self) -> float:
        """Env steps per CPU second: what one core does when nobody else wants it."""
        return self.num_steps / self.cpu_s


def measure(play: Callable[[], int], seconds: float) -> Sample:
    """Call ``play``, which returns its number of env steps, at least once and until ``seconds`` have passed."""
    wall_s, cpu_s = time.perf_counter(), time.process_time()
    num_steps = play()
    while time.perf_counter() - wall_s < seconds:
        num_steps += play()
    return Sample(num_steps, time.perf_counter() - wall_s, time.process_time() - cpu_s)


def measure_in_turn(plays: Mapping[str, Callable[[], int]], num_pairs: int, seconds: float) -> dict[str, list[Sample]]:
    """Measure each of ``plays`` for about ``seconds``, all in turn, ``num_pairs`` times, after one each to warm up."""
    for play in plays.values():
        play()
    samples: dict[str, list[Sample]] = {name: [] for name in plays}
    for _ in range(num_pairs):
        for name, play in plays.items():
            samples[name].append(measure(play, seconds))
    return samples


def rates(samples: Sequence[Sample]) -> dict[str, Any]:
    """Median rates of one thing that was measured several times, and every single rate."""
    wall, cpu = [s.steps_per_s for s in samples], [s.steps_per_cpu_s for s in samples]
    return {
        "env_steps_per_s": statistics.median(wall),
        "env_steps_per_cpu_s": statistics.median(cpu),
        "env_steps_per_s_each": wall,
        "env_steps_per_cpu_s_each": cpu,
        "num_steps": sum(sample.num_steps for sample in samples),
    }


def ratio(ours: Sequence[Sample], theirs: Sequence[Sample]) -> dict[str, float]:
    """Speed of ``ours`` over that of ``theirs``: median, least and greatest over the pairs, by wall-clock time.

    ``cpu`` is the median by CPU time, on which other programs of the machine bear less.
    """
    wall = [a.steps_per_s / b.steps_per_s for a, b in zip(ours, theirs, strict=True)]
    cpu = [a.steps_per_cpu_s / b.steps_per_cpu_s for a, b in zip(ours, theirs, strict=True)]
    return {"median": statistics.median(wall), "least": min(wall), "greatest": max(wall), "cpu": statistics.median(cpu)}


def machine() -> dict[str, Any]:
    """The commit, the processor, how busy it is with everything that runs on it, and versions of what is installed."""
    versions = {"python": platform.python_version()}
    for name in PACKAGES:
        with suppress(importlib.metadata.PackageNotFoundError):
            versions[name] = importlib.metadata.version(name)
    return {
        "time": datetime.now(UTC).isoformat(timespec="seconds"),
        "git_commit": git_commit(),
        "cpu": _cpu_model(),
        "num_cpus": os.cpu_count(),
        "load_average": [round(load, 2) for load in os.getloadavg()],
        "versions": versions,
    }


def describe(where: dict[str, Any]) -> str:
    """``machine`` in one line."""
    versions = ", ".join(f"{name} {version}" for name, version in where["versions"].items())
    return f"{where['cpu']}, {where['num_cpus']} cpus, load {where['load_average'][0]}; {versions}"


def rates_table(rows: dict[str, dict[str, Any]]) -> str:
    """The median rates of each named row, as Markdown."""
    keys = ("env_steps_per_s", "env_steps_per_cpu_s")
    cells = ((name, *(f"{row[key]:,.0f}" for key in keys)) for name, row in rows.items())
    return table(("", "env steps/s", "per CPU second"), cells)


def describe_ratio(name: str, each: dict[str, float]) -> str:
    """A result of ``ratio`` in one line."""
    return (
        f"{name}: {each['median']:.2f} ({each['least']:.2f} to {each['greatest']:.2f}; by CPU time {each['cpu']:.2f})"
    )


def write_json(path: Path, result: dict[str, Any]) -> None:
    """Write a result, its innermost lists on one line each."""
    write_atomic(path, to_text(result).encode())


def to_text(value: Any) -> str:
    """JSON for people and for ``git diff``: indented, with every list of plain values on a single line."""
    text = json.dumps(value, indent=1, allow_nan=False)
    return _PLAIN_LIST.sub(lambda found: " ".join(map(str.strip, found[0].splitlines())), text) + "\n"


# --- the command line of a benchmark ----------------------------------------------------------------------------------


def read_settings(doc: str | None, settings: type[_Settings]) -> tuple[_Settings, Path | None]:
    """A dataclass from the command line, and where to write the result.

    A field with a default is an option, one without is an argument; a tuple takes several values.
    """
    parser = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    for field in fields(settings):  # type: ignore[arg-type]
        option, value = f"--{field.name.replace('_', '-')}", field.default
        if value is MISSING:
            parser.add_argument(field.name, nargs="+" if str(field.type).startswith("tuple") else None)
        elif value is False:
            parser.add_argument(option, action="store_true")
        elif isinstance(value, tuple):
            parser.add_argument(option, action="append", default=[])
        else:
            parser.add_argument(option, type=type(value), default=value, help="default: %(default)s")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write everything measured")
    given = vars(parser.parse_args())
    file = given.pop("json")
    return settings(**{name: tuple(each) if isinstance(each, list) else each for name, each in given.items()}), file


@one_line_errors
def run_benchmark(
    name: str,
    doc: str | None,
    settings: type[_Settings],
    benchmark: Callable[[_Settings], dict[str, Any]],
    report: Callable[[dict[str, Any]], str],
    failed: Callable[[dict[str, Any]], bool] = lambda result: False,
) -> int:
    """Measure with the settings of the command line, write ``--json``, print the report.

    Args:
        name: of the benchmark in its file; a result that has another one keeps it.
        doc: what ``--help`` says.
        settings: a dataclass, see ``read_settings``.
        benchmark: measures.
        report: the result for people.
        failed: whether the exit code is 1.
    """
    chosen, file = read_settings(doc, settings)
    where = machine()
    print(describe(where), flush=True)
    head = {"benchmark": name, "machine": where, "settings": asdict(chosen)}  # type: ignore[call-overload]
    result = head | benchmark(chosen)
    if file is not None:
        write_json(file, result)
    print(report(result))
    return int(failed(result))


def _cpu_model() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()
