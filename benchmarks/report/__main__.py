"""Make the pages and pictures of recorded results anew.

    python -m benchmarks.report --docs docs

Every block between two markers of the ``PAGES`` is written anew, and all pictures; the words around the blocks stay.
Whether a target was reached is computed. A block about something that was not recorded says so.
``results/downstream.md`` is written whole.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from benchmarks import time_to_skill
from benchmarks.report import (
    attacks,
    champion,
    cluster,
    comparison,
    deployed,
    mutation,
    page_speed,
    pretraining,
    recipe,
    robots,
    robustness,
    scaling,
    skills,
    speed,
    summary,
    transfer,
)
from benchmarks.report.downstream import draw_table, write_results
from benchmarks.report.figures import (
    draw_ablations,
    draw_chaos,
    draw_coverage,
    draw_curriculum,
    draw_curves,
    draw_goals,
    draw_skill_curves,
    draw_skills,
    draw_soak,
)
from benchmarks.reproduce import Places, experiments
from benchmarks.run_files import Run, read_run
from service.downstream.files import Result
from service.downstream.results import ResultsDirectory
from service.errors import TandemError
from service.io.files import os_errors, write_atomic

PROGRAMS = {
    "env_throughput": "benchmarks.env_throughput",
    "selfplay_throughput": "benchmarks.selfplay_throughput",
    "throughput": "benchmarks.compare_commits",
    "cluster_throughput": "benchmarks.cluster_throughput of commit 82ca6fd",
    "chaos": "benchmarks.chaos of commit ddd0770",
    "rest_load": "benchmarks.rest_load of commit ddd0770",
    "soak": "benchmarks.soak of commit ddd0770",
    "strikes": "tools.strikes of commit 82ca6fd",
    "deployed": "tools.deployed",
    "mutation": "tools.mutation",
    "scaling": "benchmarks.scaling of commit 82ca6fd",
    "scaling_box": "benchmarks.scaling",
    "robots": "benchmarks.robots",
    "transfer": "benchmarks.transfer",
    "transfer_champion": "benchmarks.transfer --name transfer_champion",
    "robot_bridge": "benchmarks.robot_bridge of commit 82ca6fd",
    "world_speed": "benchmarks.compare_commits --worlds",
    "page_speed": "benchmarks.page_speed",
    "robustness": "benchmarks.robustness of commit 82ca6fd",
    "randomisation_ranges": "benchmarks.randomisation_ranges of commit 82ca6fd",
}
"""Modules by the name of the recorded file that they make."""
PAGES = {
    "results/pretraining.md": (
        *("skill", "champion", "tasks", "curves", "curriculum", "coverage", "ablations", "throughput"),
    ),
    "results/cluster.md": ("targets", "throughput", "chaos", "strikes", "rest", "soak"),
    "results/deployed.md": ("checks",),
    "results/skills.md": ("coverage", "curves", "controls"),
    "results/comparison.md": ("rows", "longer", "below", "harder", "missing"),
    "downstream.md": ("headline",),
    "robots.md": ("robots",),
    "results/transfer.md": ("transfer", "transfer_champion", "robot_bridge"),
    "api.md": ("page",),
    "results/README.md": ("throughput", "mutation"),
    "results/robust.md": ("robustness", "randomisation_ranges"),
    "../README.md": ("headline",),
    "scaling.md": ("bottleneck", "box", "model", "batches", "skill", "constants"),
}
"""Blocks of every page."""
RECIPE = "recipe"
"""Name of the recorded time to a skill with the recipe, without any change."""
ABOUT_THE_RECIPE = ("results/pretraining.md", "scaling.md")
"""Pages that show it, and so may call it the shipped recipe only while it is."""
Results = Mapping[str, Mapping[str, Any]]
"""Recorded files by the name of their benchmark."""
Blocks = Mapping[str, Sequence[str]]
"""Parts of the text of each block."""
_NOTHING = "Not recorded yet."


def begin(block: str) -> str:
    """The marker above a block."""
    return f"<!-- {block}: begin, written by benchmarks/report -->"


def end(block: str) -> str:
    """The marker below a block."""
    return f"<!-- {block}: end -->"


def replace_blocks(path: Path, blocks: Mapping[str, str]) -> str:
    """The page at ``path`` with the text of every block anew; an empty one says that nothing is recorded yet."""
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
    """Recorded files by the name of their benchmark; what is not there is left out."""
    found = {}
    for name, program in PROGRAMS.items():
        path = results / f"{name}.json"
        if not path.exists():
            continue
        try:
            result = json.loads(path.read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            raise TandemError(f"cannot read {path}: {error}; make it with python -m {program}") from error
        if not isinstance(result, dict) or name not in (result.get("benchmark"), result.get("tool")):
            raise TandemError(f"{path} is not what python -m {program} writes; make it anew")
        found[name] = result
    return found


def read_studies(directory: Path) -> dict[str, dict[str, Any]]:
    """Recorded times to a skill by the name of their file."""
    studies = {}
    for path in sorted(directory.glob("*.json")):
        with os_errors("read", path):
            studies[path.stem] = json.loads(path.read_text(encoding="utf-8"))
    return studies


def read_all(directory: Path) -> list[Run]:
    """Recorded runs in the order of their names."""
    return [read_run(path) for path in sorted(directory.glob("*.json"))]


def read_runs(directory: Path) -> tuple[list[Run], list[Run]]:
    """Recorded runs in the order of their names, and recorded ablations in that of their list."""
    runs = read_all(directory)
    ablations = [run for run in runs if "ablation" in run]
    ablations.sort(key=lambda run: (pretraining.ABLATIONS.index(run["ablation"]["name"]), run["config"]["seed"]))
    return [run for run in runs if "ablation" not in run], ablations


def robots_blocks(found: Results) -> Blocks:
    """Parts of the block about robots by description."""
    recorded, worlds = found.get("robots"), found.get("world_speed")
    parts = [robots.robots_table(recorded), robots.robots_words(recorded)] if recorded is not None else []
    parts += [robots.speed_words(worlds)] if worlds is not None else []
    return {"robots": parts} if parts else {}


def transfer_blocks(found: Results) -> Blocks:
    """Parts of the blocks about frozen policies in another engine, and through the bridge in ours."""
    blocks = {
        name: [transfer.transfer_table(found[name]), transfer.transfer_words(found[name])]
        for name in ("transfer", "transfer_champion")
        if name in found
    }
    bridge = found.get("robot_bridge")
    if bridge is not None:
        blocks["robot_bridge"] = [transfer.bridge_table(bridge), transfer.bridge_words(bridge)]
    return blocks


def page_blocks(found: Results) -> Blocks:
    """Parts of the block about the speed of the page."""
    recorded = found.get("page_speed")
    return {"page": [page_speed.page_table(recorded), page_speed.page_words(recorded)]} if recorded is not None else {}


def index_blocks(found: Results) -> Blocks:
    """Parts of the blocks of the index of results: speed, and mutation testing."""
    blocks = {}
    if speeds := [found[name] for name in ("env_throughput", "selfplay_throughput") if name in found]:
        blocks["throughput"] = [speed.ratios_block(speeds)]
    if (recorded := found.get("mutation")) is not None:
        blocks["mutation"] = [mutation.mutation_words(recorded), mutation.mutation_table(recorded)]
    return blocks


def robustness_blocks(found: Results) -> Blocks:
    """Parts of the blocks about policies in worlds that differ from those of training."""
    parts = {
        "robustness": (robustness.robustness_table, robustness.robustness_words),
        "randomisation_ranges": (robustness.ranges_table, robustness.ranges_words),
    }
    return {name: [part(found[name]) for part in both] for name, both in parts.items() if name in found}


class Report:
    """Draws pictures into ``docs/results``, and writes the pages.

    Args:
        docs: directory of the pages.
    """

    def __init__(self, docs: Path) -> None:
        self._docs, self._results = docs, docs / "results"
        self.files: list[Path] = []
        """Everything written."""

    def write(self) -> None:
        """Write all pages and pictures."""
        found, (runs, ablations) = read_results(self._results), read_runs(self._results / "runs")
        studies = read_studies(self._results / "time_to_skill")
        trials, longer = (
            ResultsDirectory(self._results / name).read_all() for name in ("downstream", "downstream_longer")
        )
        recorded_skills, controls = (read_all(self._results / name) for name in ("skills", "controls"))
        for page, names in PAGES.items():  # what is wrong with a page is found before anything is drawn
            words = replace_blocks(self._docs / page, dict.fromkeys(names, ""))
            if page in ABOUT_THE_RECIPE and RECIPE in studies:
                recipe.check_words(self._docs / page, words, studies[RECIPE])
        made = (
            self.pretraining_blocks(runs, ablations, found, studies),
            self.cluster_blocks(found),
            deployed.deployed_blocks(found),
            self.skills_blocks(recorded_skills, controls, runs),
            self.comparison_blocks(trials, longer),
            summary_blocks(trials),
            robots_blocks(found),
            transfer_blocks(found),
            page_blocks(found),
            index_blocks(found),
            robustness_blocks(found),
            summary_blocks(trials),
            scaling_blocks(found, studies),
        )
        for (page, names), blocks in zip(PAGES.items(), made, strict=True):
            path = self._docs / page
            text = replace_blocks(path, {name: "\n\n".join(blocks.get(name, ())) for name in names})
            with os_errors("write", path):
                write_atomic(path, text.encode())
            self.files.append(path)
        self.files += write_results(self._results)

    def pretraining_blocks(
        self, runs: Sequence[Run], ablations: Sequence[Run], found: Results, studies: Results
    ) -> Blocks:
        """Parts of the blocks about pre-training."""
        show, blocks = self._show, defaultdict[str, list[str]](list)
        if RECIPE in studies:
            blocks["skill"] = [recipe.recipe_words(studies[RECIPE]), time_to_skill.report(studies[RECIPE])]
        if runs:
            blocks["champion"] = [champion.champion_words(runs)]
            blocks["tasks"] = [pretraining.tasks_table(runs)]
            blocks["curves"] = [
                show("Over env steps", "pretraining", draw_curves, runs),
                show("Over wall-clock time", "pretraining-time", partial(draw_curves, over_time=True), runs),
                pretraining.training_table(runs),
            ]
        if counted := [run for run in runs if "curriculum" in run]:  # older files have only a sample of the goals
            blocks["curriculum"].append(show("The curriculum", "pretraining-curriculum", draw_curriculum, counted))
        for run in runs:
            words, picture = f"Where the goals of {run['name']} were", f"pretraining-goals-{run['name']}"
            blocks["curriculum"].append(show(words, picture, draw_goals, run))
        if covered := [run for run in runs if run.get("coverage")]:
            blocks["coverage"].append(pretraining.coverage_table(covered))
        for run in covered:
            words, picture = f"Random compositions of {run['name']}", f"pretraining-coverage-{run['name']}"
            blocks["coverage"].append(show(words, picture, draw_coverage, run))
        if ablations:
            picture = show("Ablations", "pretraining-ablations", draw_ablations, ablations)
            blocks["ablations"] = [picture, pretraining.ablations_table(ablations)]
        if "throughput" in found:
            blocks["throughput"] = [pretraining.throughput_words(found["throughput"])]
        return blocks

    def cluster_blocks(self, found: Results) -> Blocks:
        """Parts of the blocks about running on a cluster."""
        blocks = {"targets": [cluster.targets_table(found)]}
        if (throughput := found.get("cluster_throughput")) is not None:
            blocks["throughput"] = [cluster.throughput_block(throughput)]
        if (chaos := found.get("chaos")) is not None:
            picture = self._show("Success, shot at and not", "cluster-chaos", draw_chaos, chaos)
            blocks["chaos"] = [cluster.chaos_words(chaos), picture, cluster.faults_table(chaos)]
        if (strikes := found.get("strikes")) is not None:
            blocks["strikes"] = [attacks.strikes_words(strikes), attacks.strikes_table(strikes)]
        if (rest := found.get("rest_load")) is not None:
            blocks["rest"] = [cluster.latency_table(rest), cluster.rest_words(rest)]
        if (soak := found.get("soak")) is not None:
            picture = self._show("Memory of every process", "cluster-soak", draw_soak, soak)
            blocks["soak"] = [cluster.soak_words(soak), picture, cluster.soak_table(soak)]
        return blocks

    def skills_blocks(self, runs: Sequence[Run], controls: Sequence[Run], pretrained: Sequence[Run]) -> Blocks:
        """Parts of the blocks about skills, and about controls of self-play."""
        blocks = {}
        if runs:
            picture = self._show("Random skills at three stages of training", "skills", draw_skills, runs)
            blocks["coverage"] = [skills.coverage_table(runs), picture]
        if learned := [run for run in runs if run["method"] != "ours"]:
            picture = self._show("Skill discovery over env steps", "skills-curves", draw_skill_curves, learned)
            blocks["curves"] = [picture]
        if controls:
            blocks["controls"] = [skills.controls_table(controls), skills.alike_table([*pretrained, *controls])]
        return blocks

    def comparison_blocks(self, trials: Sequence[Result], longer: Sequence[Result]) -> Blocks:
        """Parts of the blocks that compare with the paper."""
        places = Places(self._results, self._results)
        blocks = {"missing": [comparison.missing_table(list(experiments(places)))]}
        if trials:
            blocks["rows"] = [comparison.comparison_table(trials)]
            blocks["below"] = [comparison.distances_table(trials)]
            blocks["harder"] = [comparison.harder_table(trials)]
        if longer:
            picture = self._show("Success over more env steps", "downstream-longer", draw_table, longer)
            blocks["longer"] = [comparison.longer_table(trials, longer), picture]
        return blocks

    def _show(self, words: str, name: str, draw: Callable[[Any, Path], Path], recorded: Any) -> str:
        self.files.append(draw(recorded, self._results / f"{name}.png"))
        return f"![{words}]({name}.png)"


def summary_blocks(trials: Sequence[Result]) -> Blocks:
    """Parts of the block that says the whole in one table."""
    return {"headline": [summary.headline_table(trials)]} if trials else {}


def scaling_blocks(found: Results, studies: Results) -> Blocks:
    """Parts of the blocks about scaling."""
    makers = {
        "bottleneck": scaling.limits_block,
        "box": scaling.box_block,
        "model": scaling.model_block,
        "constants": scaling.constants_block,
    }
    blocks = {name: [maker(found["scaling"])] for name, maker in makers.items() if "scaling" in found}
    if "scaling_box" in found:  # newer than the box of the model
        blocks["box"] = [scaling.box_block(found["scaling_box"])]
    if studies:
        blocks["batches"] = [scaling.batches_block(studies), recipe.recipe_words(studies[RECIPE])]
    if studies and "scaling" in found:
        blocks["skill"] = [scaling.skill_block(found["scaling"], studies)]
    return blocks


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
