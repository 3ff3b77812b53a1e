"""Make the pages and pictures of recorded results anew.

    python -m benchmarks.report --docs docs

Every block between two markers of ``results/pretraining.md``, ``results/cluster.md`` and ``scaling.md`` is written
anew, and all pictures; the words around the blocks stay. Whether a target was reached is computed. A block about
something that was not recorded says so. The downstream page is made by ``tandem downstream table``.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks.report import cluster, pretraining, scaling
from benchmarks.report.figures import (
    draw_ablations,
    draw_chaos,
    draw_coverage,
    draw_curriculum,
    draw_curves,
    draw_goals,
    draw_soak,
)
from benchmarks.run_files import Run, read_run
from service.errors import TandemError
from service.io.files import os_errors, write_atomic

PROGRAMS = {
    "throughput": "benchmarks.compare_commits",
    "cluster_throughput": "benchmarks.cluster_throughput",
    "chaos": "benchmarks.chaos of commit ddd0770",
    "rest_load": "benchmarks.rest_load of commit ddd0770",
    "soak": "tools.soak",
    "scaling": "benchmarks.scaling",
}
"""Modules by the name of the recorded file that they make."""
PAGES = {
    "results/pretraining.md": ("tasks", "curves", "curriculum", "coverage", "ablations", "throughput"),
    "results/cluster.md": ("targets", "throughput", "chaos", "rest", "soak"),
    "scaling.md": ("bottleneck", "box", "nodes", "model", "constants"),
}
"""Blocks of every page."""
_NOTHING = "Not recorded yet."


def begin(block: str) -> str:
    """The marker above a block."""
    return f"<!-- {block}: begin, written by benchmarks/report -->"


def end(block: str) -> str:
    """The marker below a block."""
    return f"<!-- {block}: end -->"


def replace_blocks(path: Path, blocks: Mapping[str, str]) -> str:
    """The page at ``path`` with the text of every block anew; an empty one says that nothing is recorded yet.

    Raises:
        TandemError: the page cannot be read, or lacks a marker.
    """
    with os_errors("read", path):
        page = path.read_text(encoding="utf-8")
    for block, text in blocks.items():
        before, found, rest = page.partition(begin(block))
        _, found_end, after = rest.partition(end(block))
        if not found or not found_end:
            raise TandemError(f"{path}: no markers for {block}: it needs a line {begin(block)} and a line {end(block)}")
        page = f"{before}{found}\n\n{text or _NOTHING}\n\n{found_end}{after}"
    return page


def read_results(results: Path) -> dict[str, dict[str, Any]]:
    """Recorded files by the name of their benchmark; what is not there is left out.

    Raises:
        TandemError: one cannot be read, or is another benchmark's.
    """
    found = {}
    for name, program in PROGRAMS.items():
        path = results / f"{name}.json"
        if not path.exists():
            continue
        try:
            result = json.loads(path.read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            raise TandemError(f"cannot read {path}: {error}; make it with python -m {program}") from error
        if not isinstance(result, dict) or result.get("benchmark") != name:
            raise TandemError(f"{path} is not what python -m {program} writes; make it anew")
        found[name] = result
    return found


def read_runs(directory: Path) -> tuple[list[Run], list[Run]]:
    """Recorded runs in the order of their names, and recorded ablations in that of their list.

    Raises:
        TandemError: a file cannot be read.
    """
    from benchmarks.ablations import ABLATIONS

    runs = [read_run(path) for path in sorted(directory.glob("*.json"))]
    order = {name: place for place, name in enumerate(ABLATIONS)}
    ablations = [run for run in runs if "ablation" in run]
    ablations.sort(key=lambda run: (order.get(run["ablation"]["name"], len(order)), run["config"]["seed"]))
    return [run for run in runs if "ablation" not in run], ablations


class Report:
    """Draws pictures into ``docs/results``, and collects the text of the blocks.

    Args:
        docs: directory of the pages.
    """

    def __init__(self, docs: Path) -> None:
        self._docs, self._results = docs, docs / "results"
        self.files: list[Path] = []
        """Everything written."""

    def write(self) -> None:
        """Write all pages and pictures.

        Raises:
            TandemError: a recorded file or a page cannot be read, or something cannot be written.
        """
        found, (runs, ablations) = read_results(self._results), read_runs(self._results / "runs")
        for page, names in PAGES.items():  # a page that lacks a marker is found before anything is drawn
            replace_blocks(self._docs / page, dict.fromkeys(names, ""))
        blocks = (
            self.pretraining_blocks(runs, ablations, found.get("throughput")),
            self.cluster_blocks(found),
            scaling_blocks(found.get("scaling")),
        )
        for page, texts in zip(PAGES, blocks, strict=True):
            text = replace_blocks(self._docs / page, texts)
            with os_errors("write", self._docs / page):
                write_atomic(self._docs / page, text.encode())
            self.files.append(self._docs / page)

    def pretraining_blocks(
        self, runs: Sequence[Run], ablations: Sequence[Run], throughput: Mapping[str, Any] | None
    ) -> dict[str, str]:
        """Text of the blocks about pre-training."""
        covered = [run for run in runs if run.get("coverage")]
        counted = [run for run in runs if "curriculum" in run]  # older files have only a sample of the goals
        curves, curriculum, coverage, ablated = [], [], [], []
        if runs:
            curves = [
                self._show("Over env steps", draw_curves(runs, self._at(""))),
                self._show("Over wall-clock time", draw_curves(runs, self._at("-time"), over_time=True)),
                pretraining.training_table(runs),
            ]
        if counted:
            curriculum.append(self._show("The curriculum", draw_curriculum(counted, self._at("-curriculum"))))
        for run in runs:
            picture = draw_goals(run, self._at(f"-goals-{run['name']}"))
            curriculum.append(self._show(f"Where the goals of {run['name']} were", picture))
        if covered:
            coverage.append(pretraining.coverage_table(covered))
        for run in covered:
            picture = draw_coverage(run, self._at(f"-coverage-{run['name']}"))
            coverage.append(self._show(f"Random compositions of {run['name']}", picture))
        if ablations:
            ablated.append(self._show("Ablations", draw_ablations(ablations, self._at("-ablations"))))
            ablated.append(pretraining.ablations_table(ablations))
        return {
            "tasks": pretraining.tasks_table(runs) if runs else "",
            "curves": "\n\n".join(curves),
            "curriculum": "\n\n".join(curriculum),
            "coverage": "\n\n".join(coverage),
            "ablations": "\n\n".join(ablated),
            "throughput": pretraining.throughput_words(throughput) if throughput is not None else "",
        }

    def cluster_blocks(self, found: Mapping[str, Mapping[str, Any]]) -> dict[str, str]:
        """Text of the blocks about running on a cluster."""
        blocks = {"targets": cluster.targets_table(found), "throughput": "", "chaos": "", "rest": "", "soak": ""}
        if "cluster_throughput" in found:
            blocks["throughput"] = cluster.throughput_block(found["cluster_throughput"])
        if (chaos := found.get("chaos")) is not None:
            picture = self._show("Success, shot at and not", draw_chaos(chaos, self._results / "cluster-chaos.png"))
            blocks["chaos"] = "\n\n".join((cluster.chaos_words(chaos), picture, cluster.faults_table(chaos)))
        if "rest_load" in found:
            blocks["rest"] = cluster.rest_block(found["rest_load"])
        if (soak := found.get("soak")) is not None:
            picture = self._show("Memory of every process", draw_soak(soak, self._results / "cluster-soak.png"))
            blocks["soak"] = "\n\n".join((cluster.soak_words(soak), picture, cluster.soak_table(soak)))
        return blocks

    def _at(self, name: str) -> Path:
        return self._results / f"pretraining{name}.png"

    def _show(self, words: str, picture: Path) -> str:
        self.files.append(picture)
        return f"![{words}]({picture.name})"


def scaling_blocks(result: Mapping[str, Any] | None) -> dict[str, str]:
    """Text of the blocks about scaling."""
    makers = {
        "bottleneck": scaling.limits_block,
        "box": scaling.box_block,
        "nodes": scaling.nodes_block,
        "model": scaling.model_block,
        "constants": scaling.constants_block,
    }
    return {name: maker(result) if result is not None else "" for name, maker in makers.items()}


def main() -> int:
    """Parse the command line, draw, say what was written."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--docs", type=Path, metavar="DIR", default=Path("docs"), help="default: %(default)s")
    given = parser.parse_args()
    report = Report(given.docs)
    try:
        report.write()
    except TandemError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print("\n".join(map(str, report.files)))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
