"""Records of a round, so that each test states only what matters to it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from service.generator.records import GoalRecords

STATE_SIZE = 4


def _make_records(proposal: Any, **overrides: Any) -> GoalRecords:
    """N valid goals, played as proposed by the current players and failed, from an object at the origin."""
    proposal = np.asarray(proposal, dtype=np.float64).reshape(-1, 3)
    num = len(proposal)
    fields: dict[str, Any] = {
        "start_state": np.zeros((num, STATE_SIZE)),
        "start_position": np.tile([0.0, 0.0, 0.025], (num, 1)),
        "goal": proposal,
        "proposal": proposal,
        "verdict": np.zeros(num, dtype=np.int8),
        "replayed": np.zeros(num, dtype=np.bool_),
        "from_reset": np.zeros(num, dtype=np.bool_),
        "played": np.ones(num, dtype=np.bool_),
        "solved": np.zeros(num, dtype=np.bool_),
        "num_bob_steps": np.full(num, 40),
        "alice_past": np.zeros(num, dtype=np.bool_),
        "bob_past": np.zeros(num, dtype=np.bool_),
        "round_index": np.zeros(num, dtype=np.int64),
    }
    return GoalRecords(**{**fields, **{name: np.asarray(value) for name, value in overrides.items()}})


@pytest.fixture
def make_records() -> Callable[..., GoalRecords]:
    """``make_records(proposal, **overrides)``."""
    return _make_records
