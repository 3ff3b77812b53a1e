"""Records of the goals of a round, as actors report them to the task generator."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from service.generator.validity import Verdict
from service.types import BoolArray, IntArray, StateArray

GOALS_PER_ITERATION = 32
"""Number of valid proposals kept for the run directory per iteration, at most."""


@dataclass(frozen=True, slots=True)
class GoalRecords:
    """The goal of each world in a round and its outcome; all arrays have N rows."""

    start_state: StateArray
    """(N, S) full physics state Bob started from; Alice too, unless ``replayed``."""
    start_position: StateArray
    """(N, 3) object position there, metres."""
    goal: StateArray
    """(N, 3) the goal Bob played, metres: Alice's proposal, or a replayed goal where ``replayed``."""
    proposal: StateArray
    """(N, 3) object position at the end of Alice's turn, metres."""
    verdict: NDArray[np.int8]
    """(N,) ``Verdict`` of Alice's proposal."""
    replayed: BoolArray
    """(N,) Bob played a goal from the replay buffer (``start_state`` is then that goal's own)."""
    from_reset: BoolArray
    """(N,) Bob started where a game does, as he does whenever he is evaluated."""
    played: BoolArray
    """(N,) Bob had a whole turn: there was a goal, and the physics held."""
    solved: BoolArray
    """(N,) Bob came within the success distance."""
    num_bob_steps: IntArray
    """(N,)."""
    alice_past: BoolArray
    """(N,) a past Alice proposed."""
    bob_past: BoolArray
    """(N,) a past Bob played."""
    round_index: IntArray
    """(N,) 0 for the first round after a reset."""

    @property
    def own(self) -> BoolArray:
        """(N,) Bob played the valid goal that this world's Alice had just proposed."""
        own: BoolArray = (self.verdict == Verdict.VALID) & self.played & ~self.replayed
        return own

    @property
    def current(self) -> BoolArray:
        """(N,) the current Bob played the current Alice's goal: what success statistics are about."""
        return self.own & ~self.alice_past & ~self.bob_past


def join_records(records: Sequence[GoalRecords]) -> GoalRecords:
    """Join the records of several rounds into one of all their worlds."""
    names = [field.name for field in fields(GoalRecords)]
    return GoalRecords(**{name: np.concatenate([getattr(each, name) for each in records]) for name in names})


def sampled_goals(records: GoalRecords) -> StateArray:
    """Valid proposals that the current Bob played, at most ``GOALS_PER_ITERATION``.

    Returns:
        (M, 7) start x y z, goal x y z (metres), solved 0/1.
    """
    rows = np.flatnonzero(records.own & ~records.bob_past)[:GOALS_PER_ITERATION]
    solved = records.solved[rows, None].astype(float)
    return np.concatenate([records.start_position[rows], records.goal[rows], solved], axis=1)
