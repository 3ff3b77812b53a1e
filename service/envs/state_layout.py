"""The state of a world: which of its numbers means what, declared once."""

from __future__ import annotations

from collections.abc import Mapping

from service.base.types import StateArray

Sizes = Mapping[str, int]
"""Number of columns by name, in their order."""
OBSTACLE_PREFIX = "obstacle_"
"""Begins the names of the obstacles' positions; ``obstacle_1`` is the first one described."""
_COLUMNS_EACH = 7
"""Columns of an object or obstacle: position and quaternion."""


def columns(sizes: Sizes) -> dict[str, slice]:
    """Slices of columns that stand one after the other; one of no columns is an empty slice."""
    slices, start = {}, 0
    for name, size in sizes.items():
        slices[name] = slice(start, start + size)
        start += size
    return slices


class StateLayout:
    """Columns of a world's state: MuJoCo's full physics state, then what a world remembers besides.

    In this order: time, ``positions`` (qpos), ``velocities`` (qvel), ``measured``, ``kept``. ``layout[name]`` is the
    slice of a part, which is empty where worlds have none of it.

    Args:
        positions: of joints and objects, as the model has them in qpos.
        velocities: of the same, as the model has them in qvel.
        measured: what each step writes anew, such as contacts.
        kept: what no step changes, such as the place of a box, or parameters of the physics that differ by world.
    """

    def __init__(self, *, positions: Sizes, velocities: Sizes, measured: Sizes, kept: Sizes) -> None:
        groups = ({"time": 1}, positions, velocities, measured, kept)
        self._columns = columns({name: size for group in groups for name, size in group.items()})
        assert len(self._columns) == sum(map(len, groups)), "two parts of the same name"
        first_velocity = 1 + sum(positions.values())
        self.physics = slice(0, first_velocity + sum(velocities.values()))
        """MuJoCo's full physics state."""
        self.velocities = slice(first_velocity, self.physics.stop)
        """All velocities."""
        first_kept: int = self.physics.stop + sum(measured.values())
        self.size = first_kept + sum(kept.values())
        """S, all numbers of a state."""
        self.kept = slice(first_kept, self.size)
        """Everything that no step changes."""

    def __getitem__(self, name: str) -> slice:
        """Columns of a part."""
        return self._columns[name]


def object_columns(layout: StateLayout, num: int) -> slice:
    """Columns of a state that hold poses of ``num`` objects."""
    return _pose_columns(layout, "object", num)


def obstacle_columns(layout: StateLayout, num: int) -> slice:
    """Columns of a state that hold poses of ``num`` obstacles."""
    return _pose_columns(layout, f"{OBSTACLE_PREFIX}1", num)


def _pose_columns(layout: StateLayout, first: str, num: int) -> slice:
    start = layout[first].start if num else 0
    return slice(start, start + _COLUMNS_EACH * num)


def places_at(states: StateArray, columns: slice) -> StateArray:
    """(N, K, 3) centres of the things whose poses (N, S) states have in these columns, metres; a view."""
    num = (columns.stop - columns.start) // _COLUMNS_EACH
    return states[:, columns].reshape(len(states), num, _COLUMNS_EACH)[:, :, :3]
