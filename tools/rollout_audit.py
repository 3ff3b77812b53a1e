"""Audit of a run's rollouts: its records, its ledger and what its actors handed over, compared.

The ledger in a checkpoint has the highest sequence number learned from, of each incarnation of each actor; numbers
begin at 0 and an actor's rollouts come in order. So

- the run's count is the sum of (highest + 1): were it more, one was counted twice; less, one was passed over;
- what an incarnation handed over, as the run's status told it, is its (highest + 1): were it more, one was lost after
  it was handed over. Only of those that live at the end some rollouts may be left, which came too late for an update.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

from service.base.jsonl import read_jsonl
from service.store.checkpoints import CheckpointStore
from service.store.models import RunStatus
from service.store.run_directory import RunDirectory

Ledger = Mapping[tuple[int, int], int]
"""Highest sequence by (actor, incarnation)."""


@dataclass(frozen=True, slots=True)
class Stretch:
    """An actor from when one incarnation was first seen until another was, or until the end."""

    actor: int
    first: int
    """Incarnation; those up to ``next`` belong to it, too."""
    next: int | None
    """Incarnation; None: it lived at the end."""
    num_handed: int

    def num_counted(self, ledger: Ledger) -> int:
        """Rollouts of the stretch that were learned from."""
        return sum(
            highest + 1
            for (actor, incarnation), highest in ledger.items()
            if actor == self.actor and self.first <= incarnation and (self.next is None or incarnation < self.next)
        )


def stretches_of(statuses: Sequence[RunStatus]) -> list[Stretch]:
    """Stretches of every rollout actor, from a run's statuses in order."""
    told: dict[str, list[tuple[int, int]]] = {}
    for status in statuses:
        for actor in status.actors:
            if actor.name.startswith("rollout-"):
                told.setdefault(actor.name, []).append((actor.incarnation, actor.num_rollouts))
    result = []
    for name, each in told.items():
        actor_index, first, base = int(name.partition("-")[2]), 0, 0
        for (before, _), (incarnation, num_rollouts) in pairwise(each):
            if incarnation > before:
                result.append(Stretch(actor_index, first, incarnation, num_rollouts - base))
                first, base = incarnation, num_rollouts
        result.append(Stretch(actor_index, first, None, each[-1][1] - base))
    return result


def audit_rollouts(
    rows: Sequence[Mapping[str, Any]],
    ledger: Ledger,
    end: RunStatus,
    stretches: Sequence[Stretch],
    *,
    late: bool = False,
) -> dict[str, Any]:
    """Compare all of them, of a run that one driver ran from its beginning to its end.

    Args:
        rows: of ``metrics.jsonl``.
        ledger: in the last checkpoint.
        end: the last status.
        stretches: see ``stretches_of``.
        late: whether workers were frozen: rollouts that come too late are refused then, and told of.

    Returns:
        For JSON: what was compared, and whether it is ``complete``: nothing lost, nothing counted twice, nothing
        missing in the records. Rollouts left at the end were handed over too late for the last update.
    """
    versions = [int(row["learner/version"]) for row in rows if "learner/version" in row]
    dead = [each for each in stretches if each.next is not None]
    living = [each for each in stretches if each.next is None]
    found = {
        "num_iterations": len(rows),
        "iterations_contiguous": [int(row["iteration"]) for row in rows] == list(range(1, len(rows) + 1)),
        "versions_contiguous": versions == list(range(1, len(versions) + 1)),
        "env_steps_rise": all(a["env_steps"] < b["env_steps"] for a, b in pairwise(rows)),
        "num_counted": end.num_rollouts_counted,
        "num_in_ledger": sum(highest + 1 for highest in ledger.values()),
        "num_refused": end.num_rollouts_refused,
        "num_handed_by_the_dead": sum(each.num_handed for each in dead),
        "num_counted_of_the_dead": sum(each.num_counted(ledger) for each in dead),
        "num_left_at_the_end": sum(each.num_handed - each.num_counted(ledger) for each in living),
    }
    complete = (
        found["iterations_contiguous"]
        and found["versions_contiguous"]
        and found["env_steps_rise"]
        and 0 <= found["num_in_ledger"] - found["num_counted"] <= found["num_refused"]
        and (late or found["num_refused"] == 0)
        and found["num_handed_by_the_dead"] == found["num_counted_of_the_dead"]
        and found["num_left_at_the_end"] >= 0
    )
    return {**found, "complete": complete}


def audit_run(
    directory: RunDirectory, end: RunStatus, seen: Sequence[RunStatus], *, late: bool = False
) -> dict[str, Any]:
    """Audit a run that has ended, see ``audit_rollouts``, from its directory and the statuses seen on its way."""
    newest = CheckpointStore(directory.checkpoints).load_latest()
    rows = newest.arrays["learner/counted"].tolist()
    ledger = {(int(actor), int(incarnation)): int(highest) for actor, incarnation, highest in rows}
    return audit_rollouts(read_jsonl(directory.metrics_file), ledger, end, stretches_of([*seen, end]), late=late)
