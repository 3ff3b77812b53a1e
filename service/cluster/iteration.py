"""Rounds and iterations of a cluster on their way: references to what is played, learned and recorded."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

from service.actors.rollout import MAX_POLICY_LAG
from service.base.types import Metrics
from service.methods.method import Iteration
from service.methods.workers import RoundSummary
from service.store.models import GoalGrid


@dataclass(slots=True, eq=False)
class Round:
    """A round that an actor plays, or has played and that is not learned from yet."""

    version: int
    """Of the policy that plays it."""
    weights: Any
    """Reference to the weights it is played with."""
    rollout: Any
    """Reference to its rollout."""
    goals: Any
    """Reference to the summary of its goals."""
    answer: Any
    """Reference to its ``RoundSummary``, which comes last."""
    started: float = field(default_factory=time.monotonic)
    """``time.monotonic()`` when its actor could begin with it."""
    summary: RoundSummary = field(init=False)
    """Once it is over."""
    hand_over_s: float = 0.0
    """From giving the round until its end was noticed, less playing it: all that was on its way or in line."""


@dataclass(slots=True)
class OpenIteration:
    """One iteration on its way through the learner and the task generator, which work on it side by side."""

    batch: list[Round]
    num_attempts: Counter[str] = field(default_factory=Counter)
    """Failed attempts, by worker."""
    updated: tuple[Metrics, list[bool]] | None = None
    """See ``LearnerActor.update_from``."""
    recorded: tuple[Iteration, GoalGrid, bool] | None = None
    """See ``GeneratorActor.record_from``."""


def may_begin(num_on_the_way: int, num_per_update: int) -> bool:
    """Whether another round may begin while an update takes ``num_per_update`` rollouts.

    This and ``may_update`` bound the policy lag. On the way are all rounds that updates wait for, from when they begin
    until the version that learned from them is out. There may be twice as many as an update takes: one update's worth
    is learned from while the next is played. So a round never begins more than one update ahead of the learner, and
    the lag of equally fast actors is 1.
    """
    return num_on_the_way < 2 * num_per_update


def may_update(version: int, played: Iterable[int]) -> bool:
    """Whether the version after ``version`` may be made: then no round being played ends up too far behind.

    The update after it is the first that can learn from such a round; by then ``version + 1`` is out. What was played
    already is learned from by this one.

    Args:
        version: the newest.
        played: versions of the rounds being played that updates wait for.
    """
    return all(version + 1 - each <= MAX_POLICY_LAG for each in played)
