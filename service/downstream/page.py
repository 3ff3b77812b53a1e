"""The page of results: tables in Markdown from the recorded cells, beside the paper's figures."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from service.actors.evaluation import wilson_interval
from service.downstream.methods import METHODS
from service.downstream.paper import BEST, PAPER
from service.envs.tasks import TASKS

Result = dict[str, Any]
Cell = Sequence[Result]
FINAL_SHARE = 0.9
"""Of a method's own final success: how soon it is reached is compared."""

MARK = "Written by `tandem downstream table`"
"""In every page, to tell it from one that a person wrote."""
_HEAD = f"""# Downstream

{MARK} from the files in `downstream/`, one for each cell and run; [what the tasks and
methods are](../downstream.md).
"""


def write_page(results: Sequence[Result], picture: str) -> str:
    """The whole page.

    Args:
        results: of cells.
        picture: file name of the learning curves, beside the page.
    """
    table = _Table(results)
    parts = [
        _HEAD,
        "## Success at the last step\n",
        "Share of episodes, all seeds together, with its 95 % Wilson interval; in brackets the number of seeds. Below "
        "each, the paper's.\n",
        table.rates("success_last", paper=True),
        "\n## Success at any step\n",
        table.rates("success_ever"),
        "\n## Each seed, at the last step\n",
        table.of(_seeds),
        "\n## Learning curves\n",
        f"![Success at the last step over env steps; bands from the least to the greatest seed]({picture})\n",
        "Without noise, 100 goals a point; dotted: what learns nothing. Where a curve still rises, the tables say what "
        "the method has after so many env steps, not what it would come to.\n",
        "## Env steps and time\n",
        "Learning alone, without evaluations: env steps in thousands, minutes of wall-clock time.\n",
        table.of(_cost),
        *table.efficiency(),
        "\n" + _origin(results),
    ]
    return "\n".join(parts)


class _Table:
    """Results by method and task."""

    def __init__(self, results: Sequence[Result]) -> None:
        self._cells: dict[tuple[str, str], list[Result]] = {}
        for result in sorted(results, key=lambda each: int(each["cell"]["seed"])):
            key = result["cell"]["method"], result["cell"]["task"]
            self._cells.setdefault(key, []).append(result)

    def of(self, text: Callable[[Cell], str]) -> str:
        """A row per method that has a result."""
        return _markdown([self._row(method, text) for method in METHODS if self._has(method)])

    def rates(self, key: str, *, paper: bool = False) -> str:
        """Pooled rates, below each method the paper's."""
        rows = []
        for method in METHODS:
            if self._has(method):
                rows.append(self._row(method, lambda cell: _rate(cell, key)))
                if paper and method in PAPER:
                    rows.append(("*the paper's*", *(f"*{100 * PAPER[method][task]:.0f} %*" for task in TASKS)))
        if paper:
            rows.append(("*best of the paper*", *(f"*{100 * BEST[task]:.0f} %*" for task in TASKS)))
        return _markdown(rows)

    def efficiency(self) -> Sequence[str]:
        """How soon methods that compose primitives are good, and when the first that learns from nothing is as good."""
        composing = [name for name, method in METHODS.items() if method.composes and self._has(name)]
        scratch = [name for name, method in METHODS.items() if method.learns_from_nothing and self._has(name)]
        if not composing or not scratch:
            return ()
        rows = []
        for method in composing:
            own, others = [METHODS[method].title], ["*best from scratch*"]
            for task in TASKS:
                cell = self._cells.get((method, task), [])
                level = _level(cell)
                until = _mean_until(cell, level)
                known = {name: self._cells[name, task] for name in scratch if (name, task) in self._cells}
                own.append("" if until is None else f"{until / 1e3:.0f}")
                others.append("" if until is None or not known else f"*{_soonest(known, level)}*")
            rows += [own, others]
        return (
            "\n## How soon\n",
            f"Env steps in thousands until {FINAL_SHARE:.0%} of the row's own final success, below it until the first "
            "method that learns from nothing is as good; in brackets how many of them were run on the task.\n",
            _markdown(rows),
        )

    def _has(self, method: str) -> bool:
        return any(found == method for found, _ in self._cells)

    def _row(self, method: str, text: Callable[[Cell], str]) -> Sequence[str]:
        cells = (self._cells.get((method, task)) for task in TASKS)
        return METHODS[method].title, *(text(cell) if cell else "" for cell in cells)


def steps_until(curve: Sequence[dict[str, float]], level: float) -> float | None:
    """Env steps of the first evaluation from which two in a row are at ``level`` on average; None: never.

    Two, since one of 100 goals is a noisy thing, and first passages pick the luckiest.
    """
    for first, second in pairwise(curve):
        if (first["success_last"] + second["success_last"]) / 2 >= level > 0.0:
            return first["env_steps"]
    return None


def _rate(cell: Cell, key: str) -> str:
    """``97 % [96, 98] (3)``."""
    num = sum(result["evaluation"]["num_episodes"] for result in cell)
    successes = sum(round(result["evaluation"][key] * result["evaluation"]["num_episodes"]) for result in cell)
    low, high = wilson_interval(successes, num)
    return f"{100 * successes / num:.1f} % [{100 * low:.0f}, {100 * high:.0f}] ({len(cell)})"


def _seeds(cell: Cell) -> str:
    return ", ".join(f"{100 * result['evaluation']['success_last']:.1f}" for result in cell)


def _cost(cell: Cell) -> str:
    if not cell[0]["curve"]:
        return "0"
    steps, minutes = (float(np.mean([result[key] for result in cell])) for key in ("env_steps", "wall_s"))
    return f"{steps / 1e3:.0f}, {minutes / 60:.0f} min"


def _level(cell: Cell) -> float:
    """``FINAL_SHARE`` of the final success, all seeds together."""
    return FINAL_SHARE * float(np.mean([result["evaluation"]["success_last"] for result in cell])) if cell else 0.0


def _mean_until(cell: Cell, level: float) -> float | None:
    """Env steps until a level, mean of the seeds; None: not every seed reaches it."""
    soon = [steps_until(result["curve"], level) for result in cell]
    known = [each for each in soon if each is not None]
    return float(np.mean(known)) if known and len(known) == len(cell) else None


def _soonest(cells: Mapping[str, Cell], level: float) -> str:
    """``128, scratch monolithic + HER (4)``, or ``> 200 (4)`` where no method reaches the level."""
    found = {name: _mean_until(cell, level) for name, cell in cells.items()}
    reached = {name: until for name, until in found.items() if until is not None}
    if not reached:
        longest = max(result["env_steps"] for cell in cells.values() for result in cell)
        return f"> {longest / 1e3:.0f} ({len(cells)})"
    first = min(reached, key=lambda name: reached[name])
    return f"{reached[first] / 1e3:.0f}, {METHODS[first].title} ({len(cells)})"


def _markdown(rows: Sequence[Sequence[str]]) -> str:
    head = ("", *(task.title for task in TASKS.values()))
    lines = [head, ("---",) * len(head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"


def _origin(results: Sequence[Result]) -> str:
    taken = [each["primitives"] for each in results if each["primitives"]]
    primitives = sorted({f"{each['name']} ({each['digest'][:12]})" for each in taken})
    commits = sorted({each["made"]["git_commit"][:12] for each in results if each["made"]["git_commit"]})
    return f"Primitives: {', '.join(primitives) or 'none'}. Commits: {', '.join(commits) or 'unknown'}.\n"
