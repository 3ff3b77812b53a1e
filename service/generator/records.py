"""Records of the goals of a round, as actors report them to the task generator."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class GoalRecords:
    """The goal of each world in a round and its outcome; all arrays have N rows."""

    start_state: Floats
    """(N, S) full physics state Bob started from; Alice too, unless ``replayed``."""
    start_position: Floats
    """(N, 3) object position there, metres."""
    goal: Floats
    """(N, 3) the goal Bob played, metres: Alice's proposal, or a replayed goal where ``replayed``."""
    proposal: Floats
    """(N, 3) object position at the end of Alice's turn, metres."""
    verdict: NDArray[np.int8]
    """(N,) ``Verdict`` of Alice's proposal."""
    replayed: Bools
    """(N,) Bob played a goal from the replay buffer (``start_state`` is then that goal's own)."""
    from_reset: Bools
    """(N,) Bob started where a game does, as he does whenever he is evaluated."""
    played: Bools
    """(N,) Bob had a whole turn: there was a goal, and the physics held."""
    solved: Bools
    """(N,) Bob came within the success distance."""
    num_bob_steps: Ints
    """(N,)."""
    alice_past: Bools
    """(N,) a past Alice proposed."""
    bob_past: Bools
    """(N,) a past Bob played."""
    round_index: Ints
    """(N,) 0 for the first round after a reset."""
