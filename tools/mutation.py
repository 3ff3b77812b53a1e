"""Mutation testing: change one thing in the code that learns, and see whether a test fails.

    pip install cosmic-ray==8.7.0          # anywhere; this program needs it, the project does not
    python -m tools.mutation --python .venv/bin/python --num 200 --json docs/results/mutation.json

It draws places in the code, all alike, and for each one of the operators of Cosmic Ray that change something there. A
mutant whose syntax tree is the same without its annotations is drawn again: nothing of it would ever run. The quick
tests of the mutant's own room come first, then all quick tests, then the slow ones of its own room. What no test
notices survives: either it behaves as before, or a test is missing. That takes about half a minute a mutant.
"""

from __future__ import annotations

import argparse
import ast
import difflib
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from queue import SimpleQueue
from typing import Any

import numpy as np
import pytest

from benchmarks.measuring import ROOT, machine, write_json

PACKAGES = (
    "actors", "base", "cluster", "config", "envs", "export", "generator", "learner", "methods", "policies", "registry",
    "robot", "runs", "status", "store",
)  # fmt: skip
"""Rooms of ``service`` that decide something: all but ``cli``, which is thin, and ``media``, which draws."""
TIMEOUT_S = 400.0


@dataclass(frozen=True, slots=True)
class Mutant:
    """A change of one place."""

    file: str
    """From the project's root."""
    line: int
    operator: str
    code: str
    """The whole file, changed."""

    def diff(self, original: str) -> list[str]:
        """The lines that differ."""
        lines = difflib.unified_diff(original.splitlines(), self.code.splitlines(), n=0, lineterm="")
        return [line for line in lines if not line.startswith(("---", "+++", "@@"))]


def draw_mutants(files: Sequence[Path], num: int, seed: int) -> Iterator[Mutant]:
    """Draw mutants, no two at the same place."""
    places = [(path, place) for path in files for place in sorted(_places(path.read_text(encoding="utf-8")).items())]
    rng = np.random.default_rng(seed)
    for index in rng.permutation(len(places)):
        path, ((line, _), choices) = places[index]
        code = path.read_text(encoding="utf-8")
        for choice in rng.permutation(len(choices)):
            name, operator, occurrence = choices[choice]
            changed = _mutate(code, operator, occurrence)
            if changed is not None and _without_annotations(changed) != _without_annotations(code):
                yield Mutant(str(path.relative_to(ROOT)), line, name, changed)
                num -= 1
                break
        if not num:
            return


def judge(mutant: Mutant, copy: Path, python: Path) -> str:
    """The test that noticed, as "killed by ..."; else "survived"."""
    target = copy / mutant.file
    original = target.read_text(encoding="utf-8")
    target.write_text(mutant.code, encoding="utf-8")
    try:
        own = f"tests/{Path(mutant.file).parts[1]}"
        for tests in (own, "-m", "not slow"), ("tests", "-m", "not slow"), (own, "-m", "slow"):
            if failure := _failure(tests, copy, python):
                return f"killed by {failure}"
        return "survived"
    finally:
        target.write_text(original, encoding="utf-8")


def _places(code: str) -> dict[tuple[int, int], list[tuple[str, Any, int]]]:
    """Operators, and which of their occurrences, by line and column."""
    from cosmic_ray.ast import ast_nodes, get_ast
    from cosmic_ray.plugins import get_operator, operator_names

    tree = get_ast(code)
    found: dict[tuple[int, int], list[tuple[str, Any, int]]] = {}
    for name in sorted(operator_names()):
        kind = get_operator(name)
        if kind.arguments() or name.endswith("no_op"):
            continue
        operator = kind()
        starts = (start for node in ast_nodes(tree) for start, _ in operator.mutation_positions(node))
        for occurrence, start in enumerate(starts):
            found.setdefault(start, []).append((name, operator, occurrence))
    return found


def _mutate(code: str, operator: Any, occurrence: int) -> str | None:
    from cosmic_ray.mutating import mutate_code

    changed = mutate_code(code, operator, occurrence)
    if changed is None:
        return None
    try:
        ast.parse(changed)
    except SyntaxError:  # such as {|x} of {**x}
        return None
    return str(changed)


def _without_annotations(code: str) -> str:
    """The syntax tree as text, without what ``from __future__ import annotations`` keeps from being run."""
    tree = ast.parse(code)
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            node.returns = None
        elif isinstance(node, ast.arg):
            node.annotation = None
        elif isinstance(node, ast.AnnAssign):
            node.annotation = ast.Constant(value=None)
    return ast.dump(tree)


def _left_out(directory: str, names: list[str]) -> list[str]:
    """What is not copied: big, and no test needs it."""
    return [name for name in names if directory == str(ROOT) and name in (".venv", ".git", "runs", "registry")]


def _failure(tests: Sequence[str], copy: Path, python: Path) -> str:
    """What failed first, in a line; nothing if all pass."""
    environment = {"PATH": "/usr/bin:/bin", "PYTHONPATH": str(copy), "OMP_NUM_THREADS": "1", "HOME": str(Path.home())}
    command = [str(python), "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", "-p", "no:xdist", *tests]
    try:
        done = subprocess.run(
            command, cwd=copy, env=environment, capture_output=True, text=True, timeout=TIMEOUT_S, check=False
        )
    except subprocess.TimeoutExpired:
        return f"{' '.join(tests)}, which took {TIMEOUT_S:.0f} s"
    if done.returncode in (0, pytest.ExitCode.NO_TESTS_COLLECTED):
        return ""
    failed = [line for line in done.stdout.splitlines() if line.startswith(("FAILED ", "ERROR "))]
    return failed[0][:300] if failed else f"{' '.join(tests)}, exit status {done.returncode}"


def run(num: int, seed: int, python: Path, parallel: int) -> list[dict[str, Any]]:
    """Draw and judge mutants in copies of the project; tells of each."""
    files = sorted(path for package in PACKAGES for path in (ROOT / "service" / package).rglob("*.py"))
    with tempfile.TemporaryDirectory() as place, ThreadPoolExecutor(parallel) as executor:
        copies: SimpleQueue[Path] = SimpleQueue()
        for number in range(parallel):
            copies.put(copy := Path(place) / str(number))
            shutil.copytree(ROOT, copy, ignore=_left_out)

        def unchanged(tests: Sequence[str]) -> None:
            copy = copies.get()
            if failure := _failure(tests, copy, python):  # else every mutant would seem to be killed
                raise SystemExit(f"{failure} fails without any change: mend that first")
            copies.put(copy)

        def one(mutant: Mutant) -> dict[str, Any]:
            copy = copies.get()
            try:
                outcome = judge(mutant, copy, python)
            finally:
                copies.put(copy)
            diff = mutant.diff((ROOT / mutant.file).read_text(encoding="utf-8"))
            print(f"{mutant.file}:{mutant.line} {outcome}", *diff, sep="\n  ", flush=True)
            kept = {key: value for key, value in asdict(mutant).items() if key != "code"}
            return {**kept, "diff": diff, "outcome": outcome}

        rooms = [(f"tests/{package}", "-m", "slow") for package in PACKAGES]
        list(executor.map(unchanged, [("tests", "-m", "not slow"), *rooms]))
        return list(executor.map(one, draw_mutants(files, num, seed)))


def main() -> int:
    """Parse the command line, draw, judge, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add = parser.add_argument
    add("--num", type=int, default=200, help="mutants (default: %(default)s)")
    add("--seed", type=int, default=0, help="of the draw (default: %(default)s)")
    add("--python", type=Path, metavar="FILE", default=Path(sys.executable), help="runs the tests")
    add("--parallel", type=int, default=2, help="mutants at once (default: %(default)s)")
    add("--json", type=Path, metavar="FILE", help="where to write them all")
    given = parser.parse_args()
    mutants = run(given.num, given.seed, given.python.absolute(), given.parallel)
    survivors = [each for each in mutants if each["outcome"] == "survived"]
    print(f"{len(mutants) - len(survivors)} of {len(mutants)} killed")
    if given.json:
        settings = {"num": given.num, "seed": given.seed, "packages": PACKAGES, "timeout_s": TIMEOUT_S}
        write_json(given.json, {"tool": "mutation", "recorded": machine(), "settings": settings, "mutants": mutants})
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
