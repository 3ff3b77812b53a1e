"""Mutation testing: change one thing in the code, and see whether a test fails.

    pip install --target DIR cosmic-ray==8.7.0    # for this program alone: it brings packages along
    pip install --target COV --no-deps coverage==7.10.7 pytest-cov==7.0.0    # for the project's own tests
    PYTHONPATH=DIR python -m tools.mutation --python .venv/bin/python --coverage COV --json /tmp/mutation.json

It draws places in the code, all alike, and for each one of the operators of Cosmic Ray that change something there. A
mutant whose syntax tree is the same without its annotations is drawn again: nothing of it would ever run. The tests
run once without any change, and show which lines each test file runs. A mutant is judged by the files that run its
line: the quick tests of its own room, those of the other rooms, and the slow ones of its own. Where no file runs it,
because the line runs at import or in a process of its own, it is all quick tests, and the slow ones of its room. What
no test notices survives: either it behaves as before, or a test is missing. Stopped and begun again on the same commit,
it goes on with what the JSON file and the coverage beside it do not have.
"""

from __future__ import annotations

import argparse
import ast
import difflib
import json
import shutil
import sqlite3
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from queue import SimpleQueue
from threading import Lock
from typing import Any

import numpy as np
import pytest

from benchmarks.measuring import ROOT, machine, write_json
from benchmarks.report.measured import SURVIVED

PACKAGES = (
    "actors", "base", "cluster", "config", "envs", "export", "generator", "learner", "methods", "policies", "registry",
    "robot", "runs", "status", "store",
)  # fmt: skip
"""Rooms of ``service`` that decide something: all but ``cli``, which is thin, and ``media``, which draws."""
TIMEOUT_S = 900.0
"""More than the slow tests of any room take; a mutant that makes them take longer is killed."""
Covering = dict[tuple[str, int], set[str]]
"""Test files by file and line that they run; neither what runs at import nor what runs in another process."""


@dataclass(frozen=True, slots=True)
class Mutant:
    """A change of one place."""

    file: str
    """From the project's root."""
    line: int
    operator: str
    code: str
    """The whole file, changed."""

    def diff(self) -> list[str]:
        """The lines that differ."""
        original = (ROOT / self.file).read_text(encoding="utf-8")
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


def judge(mutant: Mutant, copy: Path, python: Path, covering: Covering) -> str:
    """The test that noticed, as "killed by ..."; else "survived"."""
    target = copy / mutant.file
    original = target.read_text(encoding="utf-8")
    own = f"tests/{Path(mutant.file).parts[1]}"
    files = set().union(*(covering.get((mutant.file, line), ()) for line in statement(original, mutant.line)))
    of_room = sorted(file for file in files if file.startswith(f"{own}/"))
    rounds = [(*of_room, "-m", "not slow"), (*sorted(files - {*of_room}), "-m", "not slow"), (*of_room, "-m", "slow")]
    rounds = [tests for tests in rounds if len(tests) > 2]  # without a file it would be all tests
    if not files:
        rounds = [(own, "-m", "not slow"), ("tests", "-m", "not slow"), (own, "-m", "slow")]
    target.write_text(mutant.code, encoding="utf-8")
    try:
        failures = (_failure(tests, copy, python) for tests in rounds)
        return next((f"killed by {failure}" for failure in failures if failure), SURVIVED)
    finally:
        target.write_text(original, encoding="utf-8")


def cover(copy: Path, python: Path, coverage: Path, kept: Path) -> None:
    """Run all tests without any change, and keep in a database which lines each of them runs.

    Raises:
        SystemExit: one fails, so every mutant would seem to be killed.
    """
    measured = ("-n", "2", "--dist", "loadfile", "--cov=service", "--cov-context=test", "--cov-report=")
    if failure := _failure(("tests", *measured), copy, python, PYTHONPATH=f"{copy}:{coverage}"):
        raise SystemExit(f"{failure} fails without any change: mend that first")
    shutil.move(copy / ".coverage", kept)


def read_coverage(kept: Path) -> Covering:
    """What ``cover`` has kept."""
    found: dict[tuple[str, int], set[str]] = {}
    with sqlite3.connect(kept) as database:
        # As ``CoverageData.contexts_by_lineno`` reads it: a bit of ``numbits`` is a line.
        rows = database.execute(
            "SELECT file.path, context.context, line_bits.numbits FROM line_bits "
            "JOIN file ON file.id = file_id JOIN context ON context.id = context_id WHERE context.context != ''"
        )
        for path, context, bits in rows:
            name, test = f"service/{path.rpartition('/service/')[2]}", context.split("::")[0]
            for line in np.flatnonzero(np.unpackbits(np.frombuffer(bits, np.uint8), bitorder="little")):
                found.setdefault((name, int(line)), set()).add(test)
    return found


def statement(code: str, line: int) -> range:
    """The lines of the innermost statement with this line; of one with a body its head."""
    statements = [node for node in ast.walk(ast.parse(code)) if isinstance(node, ast.stmt)]
    innermost = min((node for node in statements if _begin(node) <= line <= _end(node)), key=_length)
    body = getattr(innermost, "body", None)
    return range(_begin(innermost), max(innermost.lineno, _begin(body[0]) - 1 if body else _end(innermost)) + 1)


def _begin(node: ast.stmt) -> int:
    decorators: list[ast.expr] = getattr(node, "decorator_list", [])
    return min(node.lineno, *(each.lineno for each in decorators)) if decorators else node.lineno


def _end(node: ast.stmt) -> int:
    return node.end_lineno or node.lineno


def _length(node: ast.stmt) -> int:
    return _end(node) - _begin(node)


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
    return [name for name in names if directory == str(ROOT) and name in (".venv", "runs", "registry")]


def _failure(tests: Sequence[str], copy: Path, python: Path, **environment: str) -> str:
    """What failed first, in a line; nothing if all pass."""
    usual = {"PATH": "/usr/bin:/bin", "PYTHONPATH": str(copy), "OMP_NUM_THREADS": "1", "HOME": str(Path.home())}
    command = [str(python), "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", *tests]
    try:
        done = subprocess.run(
            command, cwd=copy, env=usual | environment, capture_output=True, text=True, timeout=TIMEOUT_S, check=False
        )
    except subprocess.TimeoutExpired:
        return f"{' '.join(tests)}, which took {TIMEOUT_S:.0f} s"
    if done.returncode in (0, pytest.ExitCode.NO_TESTS_COLLECTED):
        return ""
    failed = [line for line in done.stdout.splitlines() if line.startswith(("FAILED ", "ERROR "))]
    return failed[0][:300] if failed else f"{' '.join(tests)}, exit status {done.returncode}"


def run(settings: dict[str, Any], python: Path, coverage: Path, parallel: int, path: Path) -> list[dict[str, Any]]:
    """Draw and judge mutants in copies of the project; tell of each, and write all so far."""
    files = sorted(path for package in PACKAGES for path in (ROOT / "service" / package).rglob("*.py"))
    before = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    recorded = {"tool": "mutation", "recorded": machine(), "settings": settings}
    # What this program writes may lie in the tree, which is dirty from then on.
    commits = [each["git_commit"].removesuffix("-dirty") for each in (before.get("recorded", machine()), machine())]
    same = before.get("settings") == settings and commits[0] == commits[1]
    judged = {(each["file"], *each["diff"]): each for each in before["mutants"]} if same else {}
    with tempfile.TemporaryDirectory() as place, ThreadPoolExecutor(parallel) as executor:
        copies: SimpleQueue[Path] = SimpleQueue()
        for number in range(parallel):
            copies.put(copy := Path(place) / str(number))
            shutil.copytree(ROOT, copy, ignore=_left_out)
        kept = path.with_suffix(".coverage")
        if not same or not kept.exists():
            cover(copy, python, coverage, kept)
        covering = read_coverage(kept)

        def one(mutant: Mutant) -> None:
            copy = copies.get()
            try:
                outcome = judge(mutant, copy, python, covering)
            finally:
                copies.put(copy)
            diff = mutant.diff()
            print(f"{mutant.file}:{mutant.line} {outcome}", *diff, sep="\n  ", flush=True)
            kept = {key: value for key, value in asdict(mutant).items() if key != "code"}
            with writing:
                judged[mutant.file, *diff] = {**kept, "diff": diff, "outcome": outcome}
                write_json(path, recorded | {"mutants": [*judged.values()]})

        writing = Lock()
        drawn = list(draw_mutants(files, settings["num"], settings["seed"]))
        list(executor.map(one, [each for each in drawn if (each.file, *each.diff()) not in judged]))
    return list(judged.values())


def main() -> int:
    """Parse the command line, draw, judge, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add = parser.add_argument
    add("--num", type=int, default=200, help="mutants (default: %(default)s)")
    add("--seed", type=int, default=0, help="of the draw (default: %(default)s)")
    add("--python", type=Path, metavar="FILE", default=Path(sys.executable), help="runs the tests")
    add("--coverage", type=Path, metavar="DIR", required=True, help="where coverage and pytest-cov are")
    add("--parallel", type=int, default=2, help="mutants at once (default: %(default)s)")
    add("--json", type=Path, metavar="FILE", required=True, help="where to write them all")
    given = parser.parse_args()
    settings = {"num": given.num, "seed": given.seed, "packages": list(PACKAGES), "timeout_s": TIMEOUT_S}
    mutants = run(settings, given.python.absolute(), given.coverage.absolute(), given.parallel, given.json)
    survivors = [each for each in mutants if each["outcome"] == SURVIVED]
    print(f"{len(mutants) - len(survivors)} of {len(mutants)} killed")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
