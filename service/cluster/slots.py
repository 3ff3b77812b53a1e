"""The bound on policy lag: how stale a rollout can get."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import count

from service.learner.weights import MAX_POLICY_LAG


@dataclass(slots=True)
class RolloutSlots:
    """Bounds the policy lag by bounding how many rollouts exist that no published version has learned from.

    A rollout holds a slot from when its round begins until the version that learned from it is out, or until it is
    lost. There are twice as many slots as an update takes rollouts: one update's worth is learned from while the next
    is played. So a round never begins more than one update ahead of the learner, and the lag of equally fast actors is
    1. An update that would leave the slowest round more than ``MAX_POLICY_LAG`` behind waits for it instead, unless
    that round was released: then its rollout is learned from only if it comes before it is too old.
    """

    _began: dict[int, int] = field(default_factory=dict)
    """Policy version by ticket, for rounds that are being played."""
    _done: set[int] = field(default_factory=set)
    """Tickets of rollouts that were played and are not yet learned from, or just being learned from."""
    _tickets: count[int] = field(default_factory=count)

    @property
    def num_taken(self) -> int:
        """Number of slots that are not free."""
        return len(self._began) + len(self._done)

    def may_begin(self, num_per_update: int) -> bool:
        """Whether another round may begin while an update takes ``num_per_update`` rollouts."""
        return self.num_taken < 2 * num_per_update

    def begin(self, version: int) -> int:
        """Take a slot for a round played with a policy version; returns its ticket."""
        ticket = next(self._tickets)
        self._began[ticket] = version
        return ticket

    def release(self, ticket: int) -> None:
        """Wait no longer for a round that is being played, and give its slot to another."""
        del self._began[ticket]

    def finish(self, ticket: int) -> None:
        """Note that the round is over and its rollout handed over, be it released or not."""
        self._began.pop(ticket, None)
        self._done.add(ticket)

    def lose(self, ticket: int) -> None:
        """Free the slot of a round, or a rollout, that will never come."""
        self._began.pop(ticket, None)
        self._done.discard(ticket)

    def may_update(self, version: int) -> bool:
        """Whether the version after ``version`` may be made: then no round being played ends up too far behind.

        The update after it is the first that can learn from such a round; by then ``version + 1`` is out. What was
        played already is learned from by this one.
        """
        return all(version + 1 - began <= MAX_POLICY_LAG for began in self._began.values())

    def publish(self, tickets: list[int]) -> None:
        """Free the slots of rollouts whose version is out."""
        self._done.difference_update(tickets)
