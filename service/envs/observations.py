"""Observations of both players as flat float32 vectors, with their reflection in y and their normalisation.

Each layout is declared once, as a list of entries; sizes, slices, mirror and normalisation follow from it. Positions
are in the world frame (origin: table top, 0.6 m in front of the robot's base). With the gripper down, the left finger
is on the side of negative y.

The paper (appendix, *State*): Alice sees the full state, Bob only positions and the goal; a value network is never
deployed and may see more. The task has no left and right: reflecting y swaps the fingers and negates every y component,
which is a signed permutation of each vector.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from service.base.types import FloatArray
from service.envs.state_layout import OBSTACLE_PREFIX, columns

if TYPE_CHECKING:
    from service.config.world import WorldConfig  # acting needs no pydantic


@dataclass(frozen=True)
class Mirror:
    """Reflection y -> -y of a vector: ``v[..., source] * sign``."""

    source: NDArray[np.int64]
    sign: FloatArray

    def __call__(self, vector: FloatArray) -> FloatArray:
        """Reflect (..., size) vectors; applying it twice gives the input back."""
        reflected: FloatArray = vector[..., self.source] * self.sign
        return reflected


@dataclass(frozen=True)
class Normalisation:
    """Fixed input scaling ``(v - offset) / scale``, and an order of objects; so primitives need no statistics."""

    offset: FloatArray
    scale: FloatArray
    by_object: NDArray[np.int64] | None = None
    """(M, n) columns of what each of M objects that are alike has, first of all its way from the end effector. Networks
    see the nearest of them first, so what is learned of one is learned of all. None where there are no such."""


class Kind(NamedTuple):
    """Reflection of one entry in y: number i becomes ``sign[i]`` times number ``source[i]``."""

    source: tuple[int, ...]
    sign: tuple[float, ...]


VECTOR = Kind((0, 1, 2), (1.0, -1.0, 1.0))
"""x, y, z."""
PAIR = Kind((1, 0), (1.0, 1.0))
"""One number for the left finger and one for the right."""
SCALAR = Kind((0,), (1.0,))
COMMAND = Kind((0, 1, 2, 3), (1.0, -1.0, 1.0, 1.0))
"""x, y, z, and one number for both fingers."""


@dataclass(frozen=True)
class Entry:
    """Named part of a vector."""

    name: str
    """Name by which ``WorldBatch.observe`` measures it or is given it."""
    kind: Kind
    unit: str
    offset: float | tuple[float, ...]
    """Subtracted to normalise; one number for all, or one each."""
    scale: float
    """Divided by to normalise."""
    of_each_object: bool = False
    """Whether it has as many numbers for each object, one object after the other."""

    def of(self, num_objects: int) -> Entry:
        """The same in a world of so many objects."""
        if not self.of_each_object or num_objects == 1:
            return self
        size, many = len(self.kind.source), range(num_objects)
        source = tuple(size * number + index for number in many for index in self.kind.source)
        offset = self.offset if isinstance(self.offset, float) else self.offset * num_objects
        return replace(self, kind=Kind(source, self.kind.sign * num_objects), offset=offset)


class ObservationLayout:
    """Named entries, one after the other, of an observation or action vector.

    ``alike`` are the numbers of objects that differ in nothing that a policy could use.
    """

    def __init__(self, *entries: Entry, alike: Sequence[int] = ()) -> None:
        self.entries, self.alike = entries, tuple(alike)
        self.columns = columns({entry.name: len(entry.kind.source) for entry in entries})
        """Slices by the entries' names."""
        assert len(self.columns) == len(entries), "two entries of the same name"
        self.size = sum(len(entry.kind.source) for entry in entries)

    def __add__(self, other: ObservationLayout) -> ObservationLayout:
        """These entries, then those of ``other``."""
        return ObservationLayout(*self.entries, *other.entries, alike=self.alike)

    def of(self, num_objects: int, alike: Sequence[int] = ()) -> ObservationLayout:
        """The same in a world of so many objects."""
        return ObservationLayout(*(entry.of(num_objects) for entry in self.entries), alike=alike)

    def __getitem__(self, name: str) -> slice:
        """Columns of an entry."""
        return self.columns[name]

    @cached_property
    def mirror(self) -> Mirror:
        """Reflection of the whole vector."""
        source = [self[entry.name].start + np.array(entry.kind.source) for entry in self.entries]
        sign = [entry.kind.sign for entry in self.entries]
        return Mirror(np.concatenate(source), np.concatenate(sign).astype(np.float32))

    @cached_property
    def normalisation(self) -> Normalisation:
        """Scaling of the whole vector."""
        offset, scale = np.empty(self.size, dtype=np.float32), np.empty(self.size, dtype=np.float32)
        for entry in self.entries:
            offset[self[entry.name]], scale[self[entry.name]] = entry.offset, entry.scale
        return Normalisation(offset, scale, self._by_object() if self.alike else None)

    def _by_object(self) -> NDArray[np.int64]:
        names = [entry.name for entry in self.entries if entry.of_each_object and entry.name != _FROM_EFFECTOR]
        num = (self[_FROM_EFFECTOR].stop - self[_FROM_EFFECTOR].start) // 3
        each = [np.arange(self[name].start, self[name].stop).reshape(num, -1) for name in (_FROM_EFFECTOR, *names)]
        return np.concatenate(each, axis=1)[list(self.alike)]


_MIDDLE_M = (0.0, 0.0, 0.15)
_FROM_EFFECTOR = "object_from_effector"

ACTION = ObservationLayout(
    Entry("displacement", VECTOR, "share of the greatest", 0.0, 1.0),
    Entry("width_change", SCALAR, "share of the greatest", 0.0, 1.0),
)
"""Command of a player."""
POSITIONS = ObservationLayout(
    Entry("effector", VECTOR, "m", _MIDDLE_M, 0.12),
    Entry("fingers", PAIR, "m", 0.02, 0.02),
    Entry("object", VECTOR, "m", _MIDDLE_M, 0.12, of_each_object=True),
    Entry(_FROM_EFFECTOR, VECTOR, "m", 0.0, 0.1, of_each_object=True),
)
"""Input of Bob's primitives in the paper, and the first entries of theirs in every world, there for each object."""
_MOTION = ObservationLayout(
    Entry("effector_velocity", VECTOR, "m/s", 0.0, 0.5),
    Entry("finger_velocities", PAIR, "m/s", 0.0, 0.2),
    Entry("object_velocity", VECTOR, "m/s", 0.0, 0.5, of_each_object=True),
    Entry("contacts", PAIR, "0 or 1", 0.5, 0.5, of_each_object=True),
)
_GOAL = ObservationLayout(Entry("goal", VECTOR, "m", _MIDDLE_M, 0.12, of_each_object=True))
_GOAL_FROM_OBJECT = ObservationLayout(Entry("goal_from_object", VECTOR, "m", 0.0, 0.1, of_each_object=True))
"""Way that each object has to go."""
_ELAPSED = ObservationLayout(Entry("elapsed", SCALAR, "share of the turn", 0.5, 0.5))
DELAY = "delay"
"""Name of the entry that says how late commands are."""
_DELAY = Entry(DELAY, SCALAR, "control steps", 1.0, 1.0)
COMMAND_PREFIX = "command_"
"""Begins the names of past commands; ``command_1`` is the last one."""


class Layouts:
    """Layouts of everything that is observed in a world.

    Entries that a world has beyond the paper's follow ``POSITIONS``, so slices of ``POSITIONS`` hold in all of one
    object.

    Args:
        num_commands: last commands that policies see.
        num_obstacles: obstacles whose positions they see.
        delay: whether they see how late commands are.
        num_objects: K.
        alike: those of them that are alike, or none.
    """

    def __init__(
        self,
        num_commands: int = 0,
        num_obstacles: int = 0,
        *,
        delay: bool = False,
        num_objects: int = 1,
        alike: Sequence[int] = (),
    ) -> None:
        motion, goal, self.way = (each.of(num_objects) for each in (_MOTION, _GOAL, _GOAL_FROM_OBJECT))
        self.num_objects, self.alike = num_objects, tuple(alike)
        obstacles = (
            Entry(f"{OBSTACLE_PREFIX}{number + 1}", VECTOR, "m", _MIDDLE_M, 0.12) for number in range(num_obstacles)
        )
        commands = (
            Entry(f"{COMMAND_PREFIX}{age + 1}", COMMAND, "share of the greatest", 0.0, 1.0)
            for age in range(num_commands)
        )
        further = ObservationLayout(*obstacles, *commands, *([_DELAY] if delay else []))
        self.positions = POSITIONS.of(num_objects, alike) + further
        """Input of Bob's primitives."""
        self.full = self.positions + motion + _ELAPSED
        """Input of Alice's policy and of her value network."""
        self.bob = self.positions + goal
        """Input of Bob's policy."""
        self.bob_value = self.positions + motion + goal + self.way
        """Input of Bob's value network."""
        self.gate = self.bob + self.way
        """Input of Bob's gate: his observation and what follows from it."""

    @property
    def spaces(self) -> dict[str, object]:
        """Sizes and layout in the manifest of primitives; they differ for another robot or another layout."""
        sizes = {"action": ACTION.size, "positions": self.positions.size, "observation": self.bob.size}
        return {**sizes, "layout": "service.envs.observations"}  # a name in every manifest, wherever this module is


def layouts(world: WorldConfig) -> Layouts:
    """Layouts of worlds of a configuration."""
    observed = world.observed
    return Layouts(
        observed.num_commands,
        world.num_observed_obstacles,
        delay=observed.delay,
        num_objects=world.num_objects,
        alike=_alike(world),
    )


def _alike(world: WorldConfig) -> list[int]:
    """Numbers of the largest group of objects that differ in color alone, which no policy sees; or none."""
    kinds = [body.model_dump(exclude={"color"}) for body in world.bodies]
    groups = [[number for number, other in enumerate(kinds) if other == kind] for kind in kinds]
    most = max(groups, key=len)
    return most if len(most) > 1 else []


PAPER = Layouts()
"""Layouts of the paper, which worlds have unless their configuration says otherwise."""
BOB, SPACES = PAPER.bob, PAPER.spaces


def each_object(rows: NDArray[Any]) -> NDArray[Any]:
    """(..., K, 3) places of K objects, which (..., 3 K) rows have one after the other; a view."""
    return rows.reshape(*rows.shape[:-1], rows.shape[-1] // 3, 3)


def distances(places: NDArray[Any], others: NDArray[Any]) -> NDArray[np.float64]:
    """(..., K) distances of each object's place of (..., 3 K) from that of others."""
    found: NDArray[np.float64] = np.linalg.norm(each_object(places - others), axis=-1)
    return found


def bob_observation(positions: FloatArray, goal: NDArray[np.floating]) -> FloatArray:
    """Bob's input (N, P + 3 K) from (N, P) positions and (N, 3 K) goals, metres."""
    return np.concatenate([positions, goal.astype(np.float32)], axis=1)
