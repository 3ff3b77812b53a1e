"""Records of the goals of a round, as actors report them to the task generator."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from service.types import BoolArray, IntArray, StateArray


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
