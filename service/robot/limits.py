"""Bounds of a commanded motion: a box, a speed and an acceleration, kept by every set-point whatever is asked for."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from service.base.types import StateArray

_NUM_HALVINGS = 6
_STILL_M_S = 1e-9


@dataclass(frozen=True)
class Box:
    """Where the set-point of the end effector may be: between two (3,) corners."""

    lower_m: StateArray
    upper_m: StateArray

    def clip(self, point_m: StateArray) -> StateArray:
        """Nearest point inside."""
        nearest: StateArray = np.clip(point_m, self.lower_m, self.upper_m)
        return nearest

    def contains(self, point_m: StateArray, margin_m: float = 0.0) -> bool:
        """Whether a point is inside, or at most ``margin_m`` outside; NaN is not."""
        return bool(((point_m >= self.lower_m - margin_m) & (point_m <= self.upper_m + margin_m)).all())

    def __str__(self) -> str:
        sides = zip("xyz", self.lower_m, self.upper_m, strict=True)
        return ", ".join(f"{axis} {low:.3f} to {high:.3f}" for axis, low, high in sides) + " m"


class SetPointLimiter:
    """Moves a set-point towards targets, within a box, a speed and an acceleration.

    It can always stop inside the box: the point where braking along the present velocity would end, ``v^2 / 2a`` ahead,
    is inside before and after every move. If a wanted velocity would end that, it is mixed with braking until it does
    not; braking alone never does, as its end stays where it was, and a box is convex. One that starts outside comes in
    within its bounds, too, and stays inside from then on.

    Args:
        box: of the set-point.
        max_speed_m_s: of its velocity's norm.
        max_acceleration_m_s2: of the norm of its change.
    """

    def __init__(self, box: Box, max_speed_m_s: float, max_acceleration_m_s2: float) -> None:
        self.box = box
        self._max_speed, self._max_acceleration = max_speed_m_s, max_acceleration_m_s2
        self.position_m: StateArray = np.full(3, np.nan)
        """(3,) the set-point."""
        self.velocity_m_s: StateArray = np.zeros(3)
        """(3,) with which it came there."""
        self._allowed = box

    def start(self, position_m: StateArray) -> None:
        """Rest at a point; one outside the box is come back from, without a jump."""
        self.position_m, self.velocity_m_s = np.array(position_m), np.zeros(3)
        self._allowed = Box(np.minimum(self.box.lower_m, position_m), np.maximum(self.box.upper_m, position_m))

    @property
    def is_still(self) -> bool:
        """Whether the set-point rests."""
        return _length(self.velocity_m_s) < _STILL_M_S

    def move(self, target_m: StateArray, arrive_s: float, gap_s: float) -> StateArray:
        """Move the set-point by one tick.

        Args:
            target_m: (3,) where to go; one outside the box means the nearest point inside.
            arrive_s: time in which to arrive there, this tick included.
            gap_s: time since the set-point was moved last.

        Returns:
            (3,) the new set-point, metres.
        """
        assert np.isfinite(target_m).all(), "a target that is not finite must not come here"
        if gap_s <= 0.0:
            return self.position_m
        way = self.box.clip(target_m) - self.position_m
        # No faster than can be braked on the way after this tick, v t + v^2 / 2a: what overshoots shakes the arm.
        stopping = math.sqrt(gap_s**2 + 2.0 * _length(way) / self._max_acceleration) - gap_s
        most = min(self._max_speed, self._max_acceleration * stopping)
        return self._go(_shortened(way / max(arrive_s, gap_s), most), gap_s)

    def brake(self, gap_s: float) -> StateArray:
        """Move the set-point by one tick so that it comes to rest as soon as it may; (3,) metres."""
        return self._go(np.zeros(3), gap_s) if gap_s > 0.0 else self.position_m

    def _go(self, wanted: StateArray, gap_s: float) -> StateArray:
        most = self._max_acceleration * gap_s
        change = _shortened(wanted - self.velocity_m_s, most)
        braking = _shortened(-self.velocity_m_s, most)
        share = 1.0
        for _ in range(_NUM_HALVINGS):
            if self._can_stop(self.velocity_m_s + share * change + (1.0 - share) * braking, gap_s, self._allowed):
                break
            share /= 2
        else:
            share = 0.0
        self.velocity_m_s = self.velocity_m_s + share * change + (1.0 - share) * braking
        # The box holds to the last bit, too.
        self.position_m = self._allowed.clip(self.position_m + self.velocity_m_s * gap_s)
        if self._allowed is not self.box and self.box.contains(self.position_m):
            came_in = self._can_stop(self.velocity_m_s, 0.0, self.box)
            self._allowed = self.box if came_in else self._allowed
        return self.position_m

    def _can_stop(self, velocity: StateArray, gap_s: float, box: Box) -> bool:
        ahead_s = gap_s + _length(velocity) / (2.0 * self._max_acceleration)
        return box.contains(self.position_m + velocity * ahead_s)


def _length(vector: StateArray) -> float:
    return math.sqrt(float(vector @ vector))  # a fifth of the time of NumPy's norm


def _shortened(vector: StateArray, most: float) -> StateArray:
    """A vector no longer than ``most``."""
    length = _length(vector)
    return vector if length <= most else vector * (most / length)
