"""An iteration on a cluster on its way: references to what was played, learned and recorded."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import Any

from service.methods.workers import GeneratorResult, RoundSummary, UpdateResult
from service.store.models import GoalGrid


@dataclass(frozen=True, slots=True)
class PendingRollout:
    """A rollout that an actor handed over and that is not learned from yet."""

    ticket: int
    version: int
    """Of the policy that played it."""
    rollout: Any
    """Reference to it."""
    goals: Any
    """Reference to the summary of its goals."""
    weights: Any
    """Reference to the weights it was played with."""
    summary: RoundSummary
    hand_over_s: float
    """From giving the round until its end was noticed, less playing it: all that was on its way or in line."""


@dataclass(slots=True)
class OpenIteration:
    """One iteration on its way through the learner and the task generator, which work on it side by side."""

    batch: list[PendingRollout]
    num_attempts: Counter[str] = field(default_factory=Counter)
    """Failed attempts, by worker."""
    weights: Any = None
    """Reference to the version that comes out of it."""
    learner_state: Any = None
    """Reference to the learner's state after it."""
    snapshot: Any = None
    """Reference to what the generator knows after it."""
    opponents: Any = None
    """Reference to the past players after it; of nothing where they are those before it."""
    generator_state: Any = None
    """Reference to the generator's state after it."""
    updated: UpdateResult | None = None
    recorded: GeneratorResult | None = None
    grid: GoalGrid | None = None

    @property
    def num_env_steps(self) -> int:
        """Env steps of its rollouts."""
        return sum(each.summary.num_env_steps for each in self.batch)
