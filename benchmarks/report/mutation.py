"""The block of ``docs/results/README.md`` about mutation testing, in Markdown, from the recorded file."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from benchmarks.report.markdown import measured_on, percent, table

Result = Mapping[str, Any]
SURVIVED = "survived"
AS_BEFORE = {
    ("baselines/rewards.py", "keep_vars=False)"): "the same numbers are saved",
    ("actors/coverage.py", "num_threads: int = 1"): "how many threads, not what they compute",
    ("actors/evaluation.py", "num_threads: int = 1"): "how many threads, not what they compute",
    ("sac/learner.py", "requires_grad_(requires_grad=True)"): "no gradient reaches the targets anyway",
    ("learner/player.py", "snapshot, strict=False)"): "a guard: the lengths never differ",
    ("downstream/page.py", "rates, strict=False)"): "a guard: the lengths never differ",
    ("actors/rollout.py", "@dataclass(frozen=False"): "a guard: nobody sets a field",
    ("generator/snapshot.py", "@dataclass(frozen=False"): "a guard: nobody sets a field",
    ("baselines/skills.py", "(place >= lower) * (place <= upper)"): "the product of booleans is their conjunction",
    ("learner/samples.py", "self.tensors()[ -1].device"): "all tensors are on one device",
    ("generator/records.py", "[from_own_start], axis=1)"): "the last axis of two",
    ("downstream/worker.py", "spread_seed(trial.seed, 4)"): "another stream of random numbers, as good as this",
    ("downstream/page.py", "/,"): "a guard: all name these arguments",
    ("downstream/page.py", "rate.num_seeds <= 1"): "there is at least one seed",
    ("downstream/page.py", "default= 1) / 1e3"): "without results nothing is drawn",
    ("learner/transfer.py", "@torch.no_grad()"): "the tensors of a state_dict ask for no gradient",
    ("learner/learner.py", "self._group.rank != 0"): "a rank is never negative",
    ("downstream/learner.py", 'rows["reward"][:, -1]'): "there is one column",
}
"""Why a survivor behaves as before, judged by hand, by its file and a part of its changed line."""


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
            f"{_file(each)}:{each['line']}",
            " ".join(f"`{_escape(line)}`" for line in _changed(each)),
            _reason(each) or "**no test**",
        )
        for each in result["mutants"]
        if each["outcome"] == SURVIVED
    ]
    return table(("in `service/`", "survived", "why"), rows)


def _file(mutant: Result) -> str:
    return str(mutant["file"]).removeprefix("service/")


def _changed(mutant: Result) -> list[str]:
    """Its changed lines; those that were taken away, where nothing was written instead."""
    for sign in "+-":
        lines = [line[1:].strip() for line in mutant["diff"] if line.startswith(sign)]
        if any(lines):
            return [line for line in lines if line]
    raise AssertionError(f"{mutant['file']}:{mutant['line']} changes nothing")


def _reason(mutant: Result) -> str | None:
    text = "\n".join(_changed(mutant))
    return next((why for (file, part), why in AS_BEFORE.items() if file == _file(mutant) and part in text), None)


def _escape(code: str) -> str:
    return code.replace("|", "\\|")
