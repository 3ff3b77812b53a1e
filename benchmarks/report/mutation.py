"""The block of ``docs/results/README.md`` about mutation testing, in Markdown, from the recorded file."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from benchmarks.report.markdown import measured_on, percent, table

Result = Mapping[str, Any]
SURVIVED = "survived"
AS_BEFORE = {
    "keep_vars=False)": "the same numbers are saved",
    "num_threads: int = 1": "how many threads, not what they compute",
    "requires_grad_(requires_grad=True)": "no gradient reaches the targets anyway",
    "snapshot, strict=False)": "a guard: the lengths never differ",
    "rates, strict=True))": "a guard: the lengths never differ",
    "@dataclass(frozen=False": "a guard: nobody sets a field",
    "(place >= lower) * (place <= upper)": "the product of booleans is their conjunction",
    "self.tensors()[ -1].device": "all tensors are on one device",
    "[from_own_start], axis=1)": "the last axis of two",
    "spread_seed(trial.seed, 4)": "another stream of random numbers, as good as this",
    "+ /,": "a guard: all name these arguments",
    "rate.num_seeds <= 1": "there is at least one seed",
    "default= 1) / 1e3": "without results nothing is drawn",
    "-@torch.no_grad()": "the tensors of a state_dict ask for no gradient",
    "self._group.rank != 0": "a rank is never negative",
    '-            rows["reward"][:, 0],': "there is one column",
}
"""Why a survivor behaves as before, by a part of its changed line."""


def mutation_words(result: Result) -> str:
    """How many mutants the tests notice, of all and of those that change behaviour."""
    mutants = result["mutants"]
    survivors = [each for each in mutants if each["outcome"] == SURVIVED]
    real = [each for each in survivors if _reason(each) is None]
    killed = len(mutants) - len(survivors)
    share = killed / (killed + len(real))
    return (
        f"Of {len(mutants)} mutants of {', '.join(result['settings']['packages'])} the tests notice {killed}. Of the "
        f"{len(survivors)} others {len(survivors) - len(real)} behave as before, so {percent(share, 1)} of "
        f"those that change behaviour are noticed; at least 90 % were asked for.{measured_on(result['recorded'])}"
    )


def mutation_table(result: Result) -> str:
    """Every survivor: where, its changed line, and why it behaves as before, if it does."""
    rows = [
        (
            f"{each['file'].removeprefix('service/')}:{each['line']}",
            " ".join(f"`{_escape(line[1:].strip())}`" for line in _changed(each)),
            _reason(each) or "**no test**",
        )
        for each in result["mutants"]
        if each["outcome"] == SURVIVED
    ]
    return table(("in `service/`", "survived", "why"), rows)


def _changed(mutant: Result) -> list[str]:
    added = [line for line in mutant["diff"] if line.startswith("+")]
    return added or [line for line in mutant["diff"] if line[1:].strip()]


def _reason(mutant: Result) -> str | None:
    text = "\n".join(mutant["diff"])
    return next((why for part, why in AS_BEFORE.items() if part in text), None)


def _escape(code: str) -> str:
    return code.replace("|", "\\|")
