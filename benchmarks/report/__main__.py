"""Make the pages and pictures of recorded results anew.

    python -m benchmarks.report --docs docs

Every block between two markers of the ``PAGES`` is written anew, and all pictures; the words around the blocks stay,
and so do blocks that were said once, by programs that are gone. Whether a target was reached is computed. A block about
something that was not recorded says so. ``results/downstream.md`` is written whole.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from benchmarks import scaling, time_to_skill, transfer
from benchmarks.measuring import one_line_errors
from benchmarks.report import comparison, figures, measured, pretraining, recipe, sentences, skills
from benchmarks.report.downstream import check_versions, draw_table, each_seed, methods_table, write_results
from benchmarks.report.results import Result, by_method_and_task, read_all
from benchmarks.reproduce import MANY_UPDATES, RESULTS, TWO_CUBES, experiments
from benchmarks.run_files import Run
from service.base.errors import TandemError
from service.base.files import os_errors, write_atomic
from service.config import load_config
from service.config.recipes import recipes

FILES = ("env_throughput", "throughput", "world_speed", "deployed", "scaling_box", "scaling_one", "scaling_two",
         "robots", "time_to_skill", "transfer", "transfer_champion", "demo", "steps_in_phi")  # fmt: skip
"""Names of the recorded files of which there is one each."""
PAGES = {
    "results/pretraining.md": (
        "skill",
        "seeds",
        "others",
        "why",
        "champion",
    ),
    "results/pretraining-v1.md": ("tasks", "curves", "curriculum", "coverage", "throughput"),
    "results/deployed.md": ("checks",),
    "results/skills.md": ("today", "phi", "coverage", "curves"),
    "results/comparison.md": ("rows", "longer", "harder", "missing"),
    "downstream.md": ("headline",),
    "robots.md": ("robots",),
    "results/transfer.md": ("transfer", "transfer_champion"),
    "results/README.md": ("throughput",),
    "../README.md": ("seeds", "headline"),
    "scaling.md": ("box", "model", "two_box", "two_model", "two_larger"),
    "hardware.md": ("demo",),
    "own_task.md": ("learned",),
    "objects.md": ("two", "tasks"),
}
"""Blocks of every page that are made anew."""
ABOUT_THE_RECIPE = ("results/pretraining.md", "scaling.md")
"""Pages that show it, and so may call it the shipped recipe only while it is."""
SEEDS, TWO, TWO_LARGER = "panda-cube", "panda-two-cubes", "panda-two-cubes-240"
"""Names of the recorded seeds of the recipe, of the one for two objects, and of that with larger updates."""
Results = Mapping[str, Mapping[str, Any]]
"""Recorded files by the name of their benchmark."""
Blocks = dict[str, list[str]]
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
        found = read_all(self._results, FILES)
        runs = [run for run in read_all(self._results / "runs").values() if "ablation" not in run]
        todays = self._results / RESULTS.name
        trials = list(read_all(todays / "downstream").values())
        on_two_cubes = list(read_all(todays / "two_cubes").values())
        check_versions(on_two_cubes)
        two_cubes = by_method_and_task(on_two_cubes)
        earlier_skills, skills_today = (list(read_all(where / "skills").values()) for where in (self._results, todays))
        for page, names in PAGES.items():  # what is wrong with a page is found before anything is drawn
            words = replace_blocks(self._docs / page, dict.fromkeys(names, ""))
            if page in ABOUT_THE_RECIPE:
                recipe.check_words(self._docs / page, words, found["time_to_skill"])
        seeds, why = read_all(self._results / "seeds"), read_all(self._results / "why_alice")
        judged = (
            pretraining.seeds_words(seeds[SEEDS]),
            time_to_skill.words(found["time_to_skill"]),
            scaling.words(found["scaling_box"]),
            pretraining.why_alice_words(why),
        )
        headline = self.headline(trials)
        made = measured_blocks(found) | {
            "results/pretraining.md": pretraining_blocks(found, seeds, why),
            "results/pretraining-v1.md": self.earlier_blocks(runs, found),
            "results/skills.md": self.skills_blocks(earlier_skills, skills_today)
            | {"phi": [skills.phi_table(found["steps_in_phi"])]},
            "results/comparison.md": self.comparison_blocks(trials),
            "downstream.md": {"headline": [headline]},
            "../README.md": {
                "headline": [headline],
                "seeds": ["\n".join(filter(None, judged))],
            },
            "own_task.md": {"learned": [measured.own_task_table(read_all(self._results / "own_task"))]},
            "objects.md": {
                "two": [pretraining.other_seeds(TWO, seeds[TWO])] if TWO in seeds else [],
                "tasks": [methods_table(two_cubes, each_seed, tasks=TWO_CUBES)] if two_cubes else [],
            },
            "scaling.md": {
                "box": [scaling.box_block(found["scaling_box"])],
                "model": [scaling.model_block(found["scaling_box"], found["time_to_skill"])],
                **two_cubes_scaling(found, seeds),
            },
        }
        for page, blocks in made.items():
            path = self._docs / page
            text = replace_blocks(path, {name: "\n\n".join(blocks[name]).rstrip() for name in PAGES[page]})
            write_atomic(path, text.encode())
            self.files.append(path)
        self.files += write_results(self._results, trials)

    def earlier_blocks(self, runs: Sequence[Run], found: Results) -> Blocks:
        """Parts of the blocks about pre-training by earlier recipes."""
        show = self.show
        counted = [run for run in runs if "curriculum" in run]  # older files have only a sample of the goals
        covered = [run for run in runs if run.get("coverage")]
        goals = [
            show(f"Where the goals of {run['name']} were", f"pretraining-goals-{run['name']}", figures.draw_goals, run)
            for run in runs
        ]
        coverage = [
            show(
                f"Random compositions of {run['name']}",
                f"pretraining-coverage-{run['name']}",
                figures.draw_coverage,
                run,
            )
            for run in covered
        ]
        return {
            "tasks": [pretraining.tasks_table(runs)],
            "curves": [
                show("Over env steps", "pretraining", figures.draw_curves, runs),
                show("Over wall-clock time", "pretraining-time", partial(figures.draw_curves, over_time=True), runs),
                pretraining.training_table(runs),
            ],
            "curriculum": [show("The curriculum", "pretraining-curriculum", figures.draw_curriculum, counted), *goals],
            "coverage": [pretraining.coverage_table(covered), *coverage],
            "throughput": [pretraining.throughput_words(found["throughput"])],
        }

    def headline(self, trials: Sequence[Result]) -> str:
        """The summary of the tasks, and what there is to say of it."""
        longer, more_updates = (self._trials(f"longer{suffix}") for suffix in ("", f"_{MANY_UPDATES}"))
        words = (
            comparison.headline_table(trials),
            sentences.ahead_words(trials, comparison.OWN, "push"),
            sentences.without_hindsight_words(trials),
            sentences.longer_words(longer, more_updates),
        )
        return "\n".join(filter(None, words))

    def _trials(self, name: str) -> list[Result]:
        """Recorded trials beside the table's, such as ``longer`` ones."""
        return list(read_all(self._results / RESULTS.name / f"downstream_{name}").values())

    def skills_blocks(self, runs: Sequence[Run], todays: Sequence[Run]) -> Blocks:
        """Parts of the blocks about skills: those of version 1 of what learns, and today's."""
        stages = self.show("Random skills at three stages of training", "skills", figures.draw_skills, runs)
        learned, learned_today = ([run for run in some if run["method"] != "ours"] for some in (runs, todays))
        curves = self.show("Skill discovery over env steps", "skills-curves", figures.draw_skill_curves, learned)
        again = self.show(
            "Skill discovery over env steps", "skills-curves-today", figures.draw_skill_curves, learned_today
        )
        return {
            "today": [skills.coverage_table(todays), skills.episodes_table(learned_today), again],
            "coverage": [skills.coverage_table(runs), stages],
            "curves": [curves],
        }

    def comparison_blocks(self, trials: Sequence[Result]) -> Blocks:
        """Parts of the blocks that compare with the paper."""
        as_paper, longer, more_updates = map(self._trials, ("paper", "longer", f"longer_{MANY_UPDATES}"))
        check_versions([*trials, *as_paper, *longer, *more_updates])
        blocks = {
            "rows": [comparison.comparison_table(trials, as_paper)],
            "longer": [],
            "harder": [comparison.harder_table(trials)],
            "missing": [comparison.missing_table(list(experiments(self._results / RESULTS.name)))],
        }
        if longer:  # none was recorded yet
            picture = self.show(
                "Success over more env steps, with 8 updates for 64", "downstream-longer", draw_table, longer
            )
            blocks["longer"] = [comparison.longer_table(trials, longer, more_updates), picture]
        return blocks

    def show(self, words: str, name: str, draw: Callable[[Any, Path], Path], recorded: Any) -> str:
        """Draw a picture; the line of a page that shows it."""
        self.files.append(draw(recorded, self._results / f"{name}.png"))
        return f"![{words}]({name}.png)"


def pretraining_blocks(found: Results, seeds: Results, why: Results) -> Blocks:
    """Parts of the blocks about pre-training by today's recipe."""
    return {
        "skill": [text(found["time_to_skill"]) for text in (recipe.recipe_words, time_to_skill.report)],
        "seeds": [text(seeds[SEEDS]) for text in (recipe.recipe_words, pretraining.seeds_block) if SEEDS in seeds],
        "others": [
            pretraining.other_seeds(name, seeds[name]) for name in seeds if name not in (SEEDS, TWO, TWO_LARGER)
        ],
        "why": [pretraining.why_alice_table(why)],
        "champion": [pretraining.champion_words(seeds[SEEDS])],
    }


def measured_blocks(found: Results) -> dict[str, Blocks]:
    """Parts of the blocks that are of one recorded file each, by page."""
    deployed, robots = found["deployed"], found["robots"]
    speed = measured.speed_words(found["world_speed"])
    return {
        "results/deployed.md": {"checks": [measured.checks_words(deployed), measured.checks_table(deployed)]},
        "robots.md": {"robots": [measured.robots_table(robots), measured.robots_words(robots), speed]},
        "results/transfer.md": {
            name: [transfer.transfer_table(found[name]), transfer.transfer_words(found[name])]
            for name in PAGES["results/transfer.md"]
        },
        "hardware.md": {"demo": [measured.demo_table(found["demo"]), measured.demo_words(found["demo"])]},
        "results/README.md": {"throughput": [measured.ratios_block(found["env_throughput"])]},
    }


def two_cubes_scaling(found: Results, seeds: Results) -> Blocks:
    """Parts of the blocks about what a run with two cubes costs, and what larger updates are worth there."""
    larger = [pretraining.larger_updates(seeds[TWO], seeds[TWO_LARGER])] if TWO_LARGER in seeds else []
    one, two = (found.get(name) for name in ("scaling_one", "scaling_two"))
    if one is None or two is None:
        return {"two_box": [], "two_model": [], "two_larger": larger}
    env_steps = load_config(recipes()[TWO]).run.total_env_steps
    return {
        "two_box": [scaling.box_block(two), scaling.beside(two, one, "one cube")],
        "two_model": [scaling.recipe_block(two, env_steps)],
        "two_larger": larger,
    }


@one_line_errors
def main() -> int:
    """Parse the command line, draw, say what was written."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--docs", type=Path, metavar="DIR", default=Path("docs"), help="default: %(default)s")
    given = parser.parse_args()
    report = Report(given.docs)
    report.write()
    print("\n".join(map(str, report.files)))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
