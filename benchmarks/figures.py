"""The page of ``docs/results`` about pre-training and its pictures, from the recorded files beside it.

    python -m benchmarks.figures pretraining --runs docs/results/runs/*.json --out docs/results

Every block of ``pretraining.md`` between two markers is written anew, and the words around the blocks stay. A block
about something that was not recorded says so.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.ablations import ABLATIONS
from benchmarks.pictures.ablations import draw_ablations
from benchmarks.pictures.coverage import draw_coverage
from benchmarks.pictures.curriculum import draw_curriculum
from benchmarks.pictures.curves import draw_curves
from benchmarks.run_files import Run, read_run
from benchmarks.tables import ablations_table, coverage_table, tasks_table, throughput_words, training_table
from service.config import WorkspaceConfig
from service.errors import TandemError
from service.io.files import os_errors, write_atomic
from service.io.jsonl import JsonlWriter
from service.io.run_directory import RunDirectory
from service.media.plots import plot_goals

BLOCKS = ("tasks", "curves", "curriculum", "coverage", "ablations", "throughput")
THROUGHPUT_FILE = "throughput.json"
_NOTHING = "Not recorded yet."


class Page:
    """Draws pictures into a directory, and collects what the page shows of them.

    Args:
        out: where pictures go, and where the page is.
    """

    def __init__(self, out: Path) -> None:
        self._out = out
        self.pictures: list[Path] = []

    def blocks(self, runs: Sequence[Run], ablations: Sequence[Run]) -> dict[str, str]:
        """Draw everything; the text of every block by its name."""
        covered = [run for run in runs if run.get("coverage")]
        return {
            "tasks": tasks_table(runs) if runs else "",
            "curves": self._curves(runs) if runs else "",
            "curriculum": self._curriculum(runs),
            "coverage": self._coverage(covered) if covered else "",
            "ablations": self._ablations(ablations) if ablations else "",
            "throughput": self._throughput(),
        }

    def _curves(self, runs: Sequence[Run]) -> str:
        steps = draw_curves(runs, self._out / "pretraining.png")
        time = draw_curves(runs, self._out / "pretraining-time.png", over_time=True)
        shown = [self._show("Over env steps", steps), self._show("Over wall-clock time", time), training_table(runs)]
        return "\n\n".join(shown)

    def _curriculum(self, runs: Sequence[Run]) -> str:
        shown = []
        if counted := [run for run in runs if "curriculum" in run]:  # older files have only a sample of the goals
            picture = draw_curriculum(counted, self._out / "pretraining-curriculum.png")
            shown.append(self._show("The curriculum", picture))
        for run in runs:
            picture = draw_goals(run, self._out / f"pretraining-goals-{run['name']}.png")
            shown.append(self._show(f"Where the goals of {run['name']} were", picture))
        return "\n\n".join(shown)

    def _coverage(self, runs: Sequence[Run]) -> str:
        shown = [coverage_table(runs)]
        for run in runs:
            picture = draw_coverage(run, self._out / f"pretraining-coverage-{run['name']}.png")
            shown.append(self._show(f"Random compositions of {run['name']}", picture))
        return "\n\n".join(shown)

    def _ablations(self, runs: Sequence[Run]) -> str:
        picture = draw_ablations(runs, self._out / "pretraining-ablations.png")
        return f"{self._show('Ablations', picture)}\n\n{ablations_table(runs)}"

    def _throughput(self) -> str:
        path = self._out / THROUGHPUT_FILE
        if not path.exists():
            return ""
        with os_errors("read", path):
            return throughput_words(json.loads(path.read_text(encoding="utf-8")))

    def _show(self, words: str, picture: Path) -> str:
        self.pictures.append(picture)
        return f"![{words}]({picture.name})"


def draw_goals(run: Run, path: Path) -> Path:
    """Draw where a run's goals were, over time."""
    workspace = WorkspaceConfig.model_validate(run["config"]["world"]["workspace"])
    with tempfile.TemporaryDirectory() as scratch:
        directory = Path(scratch) / run["name"]  # the picture's title names it
        goals = JsonlWriter(RunDirectory(directory).goals_file)
        for record in run["goals"]:
            goals.append(record)
        picture = plot_goals(directory, workspace).read_bytes()
    with os_errors("write", path):
        write_atomic(path, picture)
    return path


def begin(block: str) -> str:
    """The marker above a block."""
    return f"<!-- {block}: begin, written by benchmarks/figures.py -->"


def end(block: str) -> str:
    """The marker below a block."""
    return f"<!-- {block}: end -->"


def replace_block(page: str, block: str, text: str) -> str:
    """``page`` with ``text`` between the markers of a block.

    Raises:
        TandemError: it has not both markers.
    """
    before, found, rest = page.partition(begin(block))
    _, found_end, after = rest.partition(end(block))
    if not found or not found_end:
        raise TandemError(f"no markers for {block}: the page needs a line {begin(block)} and a line {end(block)}")
    return f"{before}{found}\n\n{text or _NOTHING}\n\n{found_end}{after}"


def empty_page() -> str:
    """A page of blocks without words."""
    parts = [f"## {block.capitalize()}\n\n{begin(block)}\n{end(block)}\n" for block in BLOCKS]
    return "\n".join(["# Pre-training\n", *parts])


def read_runs(paths: Sequence[Path]) -> tuple[list[Run], list[Run]]:
    """Recorded runs in the order given, and recorded ablations in that of their list.

    Raises:
        TandemError: a file cannot be read.
    """
    runs = [read_run(path) for path in paths]
    order = {name: place for place, name in enumerate(ABLATIONS)}
    ablations = [run for run in runs if "ablation" in run]
    ablations.sort(key=lambda run: (order.get(run["ablation"]["name"], len(order)), run["config"]["seed"]))
    return [run for run in runs if "ablation" not in run], ablations


def pretraining(run_files: Sequence[Path], out: Path) -> list[Path]:
    """Everything about pre-training: the page ``pretraining.md`` and its pictures.

    Returns:
        The files written.

    Raises:
        TandemError: a run or the page cannot be read, or something cannot be written.
    """
    runs, ablations = read_runs(run_files)
    page_file, page = out / "pretraining.md", Page(out)
    with os_errors("read", page_file):
        text = page_file.read_text(encoding="utf-8") if page_file.exists() else empty_page()
    for block in BLOCKS:
        text = replace_block(text, block, "")  # a page that lacks a marker is found before anything is drawn
    for block, content in page.blocks(runs, ablations).items():
        text = replace_block(text, block, content)
    with os_errors("write", page_file):
        write_atomic(page_file, text.encode())
    return [page_file, *page.pictures]


def main() -> int:
    """Parse the command line, draw, say what was written."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("subject", choices=("pretraining",))
    parser.add_argument("--runs", type=Path, metavar="FILE", nargs="+", required=True, help="of record_run.py")
    parser.add_argument("--out", type=Path, metavar="DIR", required=True, help="where pictures and page go")
    given = parser.parse_args()
    try:
        files = pretraining(given.runs, given.out)
    except TandemError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print("\n".join(map(str, files)))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
