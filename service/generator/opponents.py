"""Past versions of both players, and the choice of the worlds that play against them (OpenAI 2021: 20 % each way)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from service.base.tensors import split_parts
from service.base.types import Array, Arrays, BoolArray, IntArray

CURRENT = -1
"""Opponent index of the current policy version."""


@dataclass(frozen=True, slots=True)
class RoundPlan:
    """Players of a round of N worlds; at most one of the two players of a world is a past version."""

    alice_opponent: IntArray
    """(N,) index of Alice in ``Opponents.alice``, or ``CURRENT``."""
    bob_opponent: IntArray
    """(N,) index of Bob in ``Opponents.bob``, or ``CURRENT``."""

    @property
    def alice_past(self) -> BoolArray:
        """(N,) a past Alice proposes."""
        past: BoolArray = self.alice_opponent != CURRENT
        return past

    @property
    def bob_past(self) -> BoolArray:
        """(N,) a past Bob plays."""
        past: BoolArray = self.bob_opponent != CURRENT
        return past


@dataclass(frozen=True, slots=True)
class Opponents:
    """Past versions of both players, as a rollout worker gets them; read only."""

    version: int
    """Another one wherever the players are others."""
    alice: tuple[Arrays, ...] = ()
    """Alice's parameters by name, one dict a snapshot, oldest first."""
    bob: tuple[Arrays, ...] = ()
    """Bob's parameters by name, one dict a snapshot, oldest first."""

    def plan(self, num_worlds: int, fraction: float, rng: np.random.Generator) -> RoundPlan:
        """Choose which worlds meet a past Alice or Bob this round, and one snapshot of each; none while there are none.

        Args:
            num_worlds: N.
            fraction: share of worlds, each way, at most 0.5; where it is not a whole number of worlds it is met on
                average.
            rng: source of the choice.
        """
        plan = RoundPlan(np.full(num_worlds, CURRENT), np.full(num_worlds, CURRENT))
        if not self.alice or fraction == 0.0:
            return plan
        if num_worlds == 1:  # it meets one of them, or none
            drawn = rng.random()
            num_alice, num_bob = int(drawn < fraction), int(fraction <= drawn < 2 * fraction)
        else:
            num_alice = num_bob = min(_round_at_random(fraction * num_worlds, rng), num_worlds // 2)
        worlds = rng.permutation(num_worlds)
        # One past version each a round: every further one would cost another batch of inference in every step.
        plan.alice_opponent[worlds[:num_alice]] = rng.integers(len(self.alice))
        plan.bob_opponent[worlds[num_alice : num_alice + num_bob]] = rng.integers(len(self.alice))
        return plan

    def joined_by(self, alice: Mapping[str, Array], bob: Mapping[str, Array], version: int, capacity: int) -> Opponents:
        """These players and both players' newest parameters, copied; the newest ``capacity`` of all."""
        newest = [{name: np.array(array) for name, array in parameters.items()} for parameters in (alice, bob)]
        return Opponents(version, (*self.alice, newest[0])[-capacity:], (*self.bob, newest[1])[-capacity:])

    def state(self) -> Arrays:
        """All parameters as ``SNAPSHOT/PLAYER/NAME``; the version is left out."""
        return {
            f"{index}/{player}/{name}": array
            for player, snapshots in (("alice", self.alice), ("bob", self.bob))
            for index, parameters in enumerate(snapshots)
            for name, array in parameters.items()
        }

    @classmethod
    def from_state(cls, version: int, state: Mapping[str, Array]) -> Opponents:
        """The players that ``state`` gave, as another version; ``num``, which a pending round adds, is not needed."""
        snapshots = split_parts({name: array for name, array in state.items() if name != "num"})
        pairs = [split_parts(snapshots[index]) for index in sorted(snapshots, key=int)]
        return cls(version, tuple(each["alice"] for each in pairs), tuple(each["bob"] for each in pairs))


def _round_at_random(count: float, rng: np.random.Generator) -> int:
    """Round up or down at random with mean ``count``, so that an actor of a few worlds meets past opponents, too."""
    whole = int(np.floor(count + 1e-9))
    rest = count - whole
    return whole + int(rest > 1e-9 and rng.random() < rest)
