"""The share of each rank of a learner: of an iteration's rollouts, of minibatches, of the learner's state.

Ranks share out rollouts in the order in which one learner would join them, a run of neighbours each. ``Share`` says at
which places of the joined rows a rank's own rows stand. So minibatches that are drawn from the joined rows are the same
sets for any number of ranks. No torch here: the driver of a cluster uses it, too.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from service.io.tensors import join_parts, split_parts
from service.types import Array, Arrays, IntArray

if TYPE_CHECKING:
    from service.learner.group import Group

Item = TypeVar("Item")
HISTORIES = DEMONSTRATIONS, IMITATED = "demonstrations", "imitated"
"""Names of what is cloned in a learner's state, each a ``DemonstrationHistory``."""


@dataclass(frozen=True, slots=True)
class Share:
    """Places of a rank's own rows among those of all ranks."""

    places: IntArray
    """(N,) of the own rows, ascending."""
    total: int
    """Rows of all ranks."""

    def mirrored(self) -> Share:
        """Each rank's rows, followed by as many reflections; all ranks' rows come before all reflections."""
        return Share(np.concatenate((self.places, self.total + self.places)), 2 * self.total)

    def find(self, drawn: IntArray) -> tuple[IntArray, Share]:
        """The own rows (M,) among drawn places, in their order, and their share of what was drawn."""
        if len(self.places) == 0:
            return np.zeros(0, dtype=np.int64), Share(np.zeros(0, dtype=np.int64), len(drawn))
        rows = np.minimum(np.searchsorted(self.places, drawn), len(self.places) - 1)
        found = np.flatnonzero(self.places[rows] == drawn)
        return rows[found], Share(found, len(drawn))


def share_of(blocks: IntArray, group: Group) -> Share | None:
    """The share of a rank whose rows come in blocks, (B,) sizes; None without other ranks.

    Joined, the first blocks of all ranks come first, by rank, then all second blocks. A rank may have fewer blocks.
    """
    if group.size == 1:
        return None
    sizes = group.gather(blocks)
    table = np.zeros((max(map(len, sizes)), group.size), dtype=np.int64)
    for rank, each in enumerate(sizes):
        table[: len(each), rank] = each
    starts = (table.cumsum() - table.ravel()).reshape(table.shape)[: len(blocks), group.rank]
    within = np.arange(blocks.sum()) - np.repeat(blocks.cumsum() - blocks, blocks)
    return Share(np.repeat(starts, blocks) + within, int(table.sum()))


def share_out(items: Sequence[Item], rank: int, size: int) -> Sequence[Item]:
    """The items of one of ``size`` ranks: neighbours; numbers differ by one at most."""
    return items[_slice(len(items), rank, size)]


def own_demonstrations(state: Mapping[str, Array], rank: int, size: int) -> Arrays:
    """The part of a rank of the state of a ``DemonstrationHistory``: of each iteration's steps a run of neighbours."""
    if size == 1:
        return dict(state)
    ends = np.cumsum(state["num_steps"])
    cuts = [_slice(int(num), rank, size) for num in state["num_steps"]]
    starts = ends - state["num_steps"]
    steps = [np.arange(start + cut.start, start + cut.stop) for start, cut in zip(starts, cuts, strict=True)]
    rows = np.concatenate([np.zeros(0, dtype=np.int64), *steps])
    own = {name: state[name][rows] for name in ("observation", "action")}
    return own | {"num_steps": np.array([len(each) for each in steps], dtype=np.int64)}


def join_states(states: Sequence[Arrays]) -> Arrays:
    """The state that one learner would have, from what ``Learner.state`` gave on every rank, by rank.

    Any number of ranks can load it. What all ranks have alike is that of rank 0; demonstrations and Bob's window are
    joined iteration by iteration.
    """
    if len(states) == 1:
        return states[0]
    parts = [split_parts(state) for state in states]
    window: Arrays = {}
    num_places: dict[str, int] = {}
    for each in parts:
        for iteration, turns in sorted(split_parts(each.pop("window", {})).items()):
            for _, arrays in sorted(split_parts(turns).items()):
                place = num_places[iteration] = num_places.get(iteration, -1) + 1
                window |= join_parts({f"{iteration}/{place:04}": arrays})
    histories = [name for name in HISTORIES if name in parts[0]]
    kept = {name: _join_demonstrations([each[name] for each in parts]) for name in histories}
    own = tuple(f"{name}/" for name in ("window", *histories))
    alike = {name: array for name, array in states[0].items() if not name.startswith(own)}
    return alike | join_parts(kept | {"window": window})


def _join_demonstrations(states: Sequence[Arrays]) -> Arrays:
    sizes = np.stack([state["num_steps"] for state in states], axis=1)  # (iterations, ranks)
    ends = sizes.cumsum(0)
    order = [(rank, ends[index, rank] - num, ends[index, rank]) for (index, rank), num in np.ndenumerate(sizes)]
    joined = {
        name: np.concatenate([states[0][name][:0], *(states[rank][name][start:end] for rank, start, end in order)])
        for name in ("observation", "action")
    }
    return joined | {"num_steps": sizes.sum(1)}


def _slice(num: int, rank: int, size: int) -> slice:
    return slice(num * rank // size, num * (rank + 1) // size)
