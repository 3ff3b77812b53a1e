"""Whether a run counted everything once: its records, its ledger and what its actors handed over, compared.

The ledger in a checkpoint has the highest sequence number learned from, of each incarnation of each actor; numbers
begin at 0 and an actor's rollouts come in order. So

- the run's count is the sum of (highest + 1): were it more, one was counted twice; less, one was passed over;
- what an incarnation handed over, as the run's status told it, is its (highest + 1): were it more, one was lost after
  it was handed over. Only of those that live at the end some rollouts may be left, which came too late for an update.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise
from typing import Any

from benchmarks.strikes import Seen
from service.store.models import RunStatus

Ledger = Mapping[tuple[int, int], int]
"""Highest sequence by (actor, incarnation)."""


@dataclass(frozen=True, slots=True)
class Stretch:
    """An actor's seat from when one incarnation was first seen until another was, or until the end."""

    actor: int
    first: int
    """Incarnation, and all before ``next``."""
    next: int | None
    """Incarnation; None: it lived at the end."""
    num_handed: int


@dataclass(frozen=True, slots=True)
class Account:
    """What was found; all is well if ``complete``."""

    num_iterations: int
    iterations_contiguous: bool
    versions_contiguous: bool
    env_steps_rise: bool
    num_counted: int
    """Rollouts that the driver says the learner counted."""
    num_in_ledger: int
    num_refused: int
    num_handed_by_the_dead: int
    """Rollouts that killed incarnations had handed over."""
    num_counted_of_the_dead: int
    num_left_at_the_end: int
    """Handed over, and too late for the last update."""

    @property
    def complete(self) -> bool:
        """Nothing lost, nothing counted twice, nothing missing in the records."""
        return (
            self.iterations_contiguous
            and self.versions_contiguous
            and self.env_steps_rise
            and self.num_counted == self.num_in_ledger
            and self.num_refused == 0
            and self.num_handed_by_the_dead == self.num_counted_of_the_dead
            and self.num_left_at_the_end >= 0
        )

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {**asdict(self), "complete": self.complete}


def ledger_of(rows: Sequence[Sequence[int]]) -> dict[tuple[int, int], int]:
    """The ledger from its rows in a checkpoint: actor, incarnation, highest sequence."""
    return {(int(actor), int(incarnation)): int(highest) for actor, incarnation, highest in rows}


def handed(seen: Sequence[Seen]) -> list[Stretch]:
    """What the incarnations of every rollout actor handed over, from a run's statuses in order."""
    result = []
    names = dict.fromkeys(actor.name for each in seen for actor in each.status.actors)
    for name in names:
        if not name.startswith("rollout-"):
            continue
        index, told = int(name.partition("-")[2]), [actor for each in seen if (actor := each.actor(name)) is not None]
        turns = [0, *(i for i in range(1, len(told)) if told[i].incarnation > told[i - 1].incarnation)]
        bases = [0, *(told[i].num_rollouts for i in turns[1:])]
        for place, (turn, base) in enumerate(zip(turns, bases, strict=True)):
            last = place + 1 == len(turns)
            end = told[-1].num_rollouts if last else bases[place + 1]
            after = None if last else told[turns[place + 1]].incarnation
            first = 0 if place == 0 else told[turn].incarnation
            result.append(Stretch(index, first, after, end - base))
    return result


def account(rows: Sequence[Mapping[str, Any]], ledger: Ledger, end: RunStatus, stretches: Sequence[Stretch]) -> Account:
    """Compare all of them, of a run that one driver ran from its beginning to its end.

    Args:
        rows: of ``metrics.jsonl``.
        ledger: in the last checkpoint.
        end: the last status.
        stretches: see ``handed``.
    """
    versions = [int(row["learner/version"]) for row in rows if "learner/version" in row]
    steps = [int(row["env_steps"]) for row in rows]
    dead = [each for each in stretches if each.next is not None]
    living = [each for each in stretches if each.next is None]
    return Account(
        num_iterations=len(rows),
        iterations_contiguous=[int(row["iteration"]) for row in rows] == list(range(1, len(rows) + 1)),
        versions_contiguous=versions == list(range(1, len(versions) + 1)),
        env_steps_rise=all(a < b for a, b in pairwise(steps)),
        num_counted=end.num_rollouts_counted,
        num_in_ledger=sum(highest + 1 for highest in ledger.values()),
        num_refused=end.num_rollouts_refused,
        num_handed_by_the_dead=sum(each.num_handed for each in dead),
        num_counted_of_the_dead=sum(_counted(ledger, each) for each in dead),
        num_left_at_the_end=sum(each.num_handed - _counted(ledger, each) for each in living),
    )


def _counted(ledger: Ledger, stretch: Stretch) -> int:
    return sum(
        highest + 1
        for (actor, incarnation), highest in ledger.items()
        if actor == stretch.actor
        and incarnation >= stretch.first
        and (stretch.next is None or incarnation < stretch.next)
    )
