"""Observations of both players as flat float32 vectors, with their reflection in y and their normalisation.

Each layout is declared once, as a list of entries; sizes, slices, mirror and normalisation follow from it. Positions
are in the world frame (origin: table top, 0.6 m in front of the robot's base). With the gripper down, the left finger
is on the side of negative y.

The paper (appendix, *State*): Alice sees the full state, Bob only positions and the goal; a value network is never
deployed and may see more. The task has no left and right: reflecting y swaps the fingers and negates every y component,
which is a signed permutation of each vector.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

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
    """Fixed affine input scaling ``(v - offset) / scale``; constants, so a frozen primitive needs no statistics."""

    offset: FloatArray
    scale: FloatArray


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


class ObservationLayout:
    """Named entries, one after the other, of an observation or action vector."""

    def __init__(self, *entries: Entry) -> None:
        self.entries = entries
        self.columns = columns({entry.name: len(entry.kind.source) for entry in entries})
        """Slices by the entries' names."""
        assert len(self.columns) == len(entries), "two entries of the same name"
        self.size = sum(len(entry.kind.source) for entry in entries)

    def __add__(self, other: ObservationLayout) -> ObservationLayout:
        """These entries, then those of ``other``."""
        return ObservationLayout(*self.entries, *other.entries)

    def without(self, name: str) -> ObservationLayout:
        """The others, in their order."""
        return ObservationLayout(*(entry for entry in self.entries if entry.name != name))

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
        return Normalisation(offset, scale)


_MIDDLE_M = (0.0, 0.0, 0.15)

ACTION = ObservationLayout(
    Entry("displacement", VECTOR, "share of the greatest", 0.0, 1.0),
    Entry("width_change", SCALAR, "share of the greatest", 0.0, 1.0),
)
"""Command of a player."""
POSITIONS = ObservationLayout(
    Entry("effector", VECTOR, "m", _MIDDLE_M, 0.12),
    Entry("fingers", PAIR, "m", 0.02, 0.02),
    Entry("object", VECTOR, "m", _MIDDLE_M, 0.12),
    Entry("object_from_effector", VECTOR, "m", 0.0, 0.1),
)
"""Input of Bob's primitives in the paper, and the first entries of theirs in every world."""
_MOTION = ObservationLayout(
    Entry("effector_velocity", VECTOR, "m/s", 0.0, 0.5),
    Entry("finger_velocities", PAIR, "m/s", 0.0, 0.2),
    Entry("object_velocity", VECTOR, "m/s", 0.0, 0.5),
    Entry("contacts", PAIR, "0 or 1", 0.5, 0.5),
)
_GOAL = ObservationLayout(Entry("goal", VECTOR, "m", _MIDDLE_M, 0.12))
GOAL_FROM_OBJECT = ObservationLayout(Entry("goal_from_object", VECTOR, "m", 0.0, 0.1))
"""Way that the object has to go."""
_ELAPSED = ObservationLayout(Entry("elapsed", SCALAR, "share of the turn", 0.5, 0.5))
DELAY = "delay"
"""Name of the entry that says how late commands are."""
_DELAY = Entry(DELAY, SCALAR, "control steps", 1.0, 1.0)
COMMAND_PREFIX = "command_"
"""Begins the names of past commands; ``command_1`` is the last one."""


class Layouts:
    """Layouts of everything that is observed in a world.

    Entries that a world has beyond the paper's follow ``POSITIONS``, so slices of ``POSITIONS`` hold in all.

    Args:
        num_commands: last commands that policies see.
        num_obstacles: obstacles whose positions they see.
        delay: whether they see how late commands are.
    """

    def __init__(self, num_commands: int = 0, num_obstacles: int = 0, *, delay: bool = False) -> None:
        obstacles = (
            Entry(f"{OBSTACLE_PREFIX}{number + 1}", VECTOR, "m", _MIDDLE_M, 0.12) for number in range(num_obstacles)
        )
        commands = (
            Entry(f"{COMMAND_PREFIX}{age + 1}", COMMAND, "share of the greatest", 0.0, 1.0)
            for age in range(num_commands)
        )
        self.positions = POSITIONS + ObservationLayout(*obstacles, *commands, *([_DELAY] if delay else []))
        """Input of Bob's primitives."""
        self.full = self.positions + _MOTION + _ELAPSED
        """Input of Alice's policy and of her value network."""
        self.bob = self.positions + _GOAL
        """Input of Bob's policy."""
        self.bob_value = self.positions + _MOTION + _GOAL + GOAL_FROM_OBJECT
        """Input of Bob's value network."""
        self.gate = self.bob + GOAL_FROM_OBJECT
        """Input of Bob's gate: his observation and what follows from it."""

    @property
    def spaces(self) -> dict[str, object]:
        """Sizes and layout in the manifest of primitives; they differ for another robot or another layout."""
        sizes = {"action": ACTION.size, "positions": self.positions.size, "observation": self.bob.size}
        return {**sizes, "layout": __name__}


def layouts(world: WorldConfig) -> Layouts:
    """Layouts of worlds of a configuration."""
    return Layouts(world.observed.num_commands, world.num_observed_obstacles, delay=world.observed.delay)


PAPER = Layouts()
"""Layouts of the paper, which worlds have unless their configuration says otherwise."""
FULL, BOB, BOB_VALUE, GATE, SPACES = PAPER.full, PAPER.bob, PAPER.bob_value, PAPER.gate, PAPER.spaces


def bob_observation(positions: FloatArray, goal: NDArray[np.floating]) -> FloatArray:
    """Bob's input (N, P + 3) from (N, P) positions and (N, 3) goals, metres."""
    return np.concatenate([positions, goal.astype(np.float32)], axis=1)
