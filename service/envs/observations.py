"""What the players see, as flat float32 vectors, and how those vectors reflect in y.

Positions are metres in the world frame (origin: table top, 0.6 m in front of the robot's base), velocities m/s. With
the gripper down, the left finger is on the side of negative y.

| vector | size | content |
|---|---|---|
| positions | 11 | end effector 3, fingers 2 (left, right), object 3, object relative to end effector 3 |
| full | 22 | positions 11; velocities of end effector 3, fingers 2, object 3; finger contacts 2; share of turn |
| bob | 14 | positions 11, goal 3 |
| bob value | 27 | full without the elapsed share 21, goal 3, goal relative to object 3 |

The paper (appendix, *State*): Alice sees the full state, Bob only positions and the goal; a value network is never
deployed and may see more. The task has no left and right: reflecting y swaps the fingers and negates every y component,
which is a signed permutation of each vector.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float32]

ACTION_SIZE = 4
POSITIONS_SIZE = 11
FULL_SIZE = 22
BOB_SIZE = POSITIONS_SIZE + 3
BOB_VALUE_SIZE = FULL_SIZE - 1 + 6
EFFECTOR_SLICE = slice(0, 3)
OBJECT_SLICE = slice(5, 8)
GOAL_SLICE = slice(11, 14)
SPACES = {"action": ACTION_SIZE, "positions": POSITIONS_SIZE, "observation": BOB_SIZE, "layout": __name__}
"""What the manifest of primitives says they act by and see; those of another robot or layout say something else."""


@dataclass(frozen=True)
class Mirror:
    """Reflection y -> -y of a vector: ``v[..., source] * sign``."""

    source: NDArray[np.int64]
    sign: FloatArray

    def __call__(self, vector: FloatArray) -> FloatArray:
        """Reflect (..., size) vectors; applying it twice gives the input back."""
        reflected: FloatArray = vector[..., self.source] * self.sign
        return reflected


def _mirror(layout: str) -> Mirror:
    """Build from a layout string: ``v`` a 3-vector (x, y, z), ``p`` a left-right pair, ``s`` a scalar."""
    source: list[int] = []
    sign: list[float] = []
    for kind in layout:
        start = len(source)
        if kind == "v":
            source += [start, start + 1, start + 2]
            sign += [1.0, -1.0, 1.0]
        elif kind == "p":
            source += [start + 1, start]
            sign += [1.0, 1.0]
        else:
            source.append(start)
            sign.append(1.0)
    return Mirror(np.asarray(source), np.asarray(sign, dtype=np.float32))


MIRROR_ACTION = _mirror("vs")
MIRROR_FULL = _mirror("vpvvvpvps")
MIRROR_BOB = _mirror("vpvvv")
MIRROR_BOB_VALUE = _mirror("vpvvvpvpvv")


@dataclass(frozen=True)
class Normalisation:
    """Fixed affine input scaling ``(v - offset) / scale``; constants, so a frozen primitive needs no statistics."""

    offset: FloatArray
    scale: FloatArray


_POSITION = (0.0, 0.0, 0.15), (0.12, 0.12, 0.12)
_FINGERS = (0.02, 0.02), (0.02, 0.02)
_RELATIVE = (0.0, 0.0, 0.0), (0.1, 0.1, 0.1)
_VELOCITY = (0.0, 0.0, 0.0), (0.5, 0.5, 0.5)
_FINGER_VELOCITIES = (0.0, 0.0), (0.2, 0.2)
_CONTACTS = (0.5, 0.5), (0.5, 0.5)
_ELAPSED = (0.5,), (0.5,)


def _normalisation(*parts: tuple[tuple[float, ...], tuple[float, ...]]) -> Normalisation:
    offset = np.concatenate([part[0] for part in parts]).astype(np.float32)
    scale = np.concatenate([part[1] for part in parts]).astype(np.float32)
    return Normalisation(offset, scale)


_POSITIONS = (_POSITION, _FINGERS, _POSITION, _RELATIVE)
_PRIVILEGED = (_VELOCITY, _FINGER_VELOCITIES, _VELOCITY, _CONTACTS)
NORMALISATION_POSITIONS = _normalisation(*_POSITIONS)
NORMALISATION_FULL = _normalisation(*_POSITIONS, *_PRIVILEGED, _ELAPSED)
NORMALISATION_BOB = _normalisation(*_POSITIONS, _POSITION)
NORMALISATION_BOB_VALUE = _normalisation(*_POSITIONS, *_PRIVILEGED, _POSITION, _RELATIVE)


def bob_observation(positions: FloatArray, goal: NDArray[np.floating]) -> FloatArray:
    """Bob's input (N, 14) from (N, 11) positions and (N, 3) goals, metres."""
    return np.concatenate([positions, goal.astype(np.float32)], axis=1)
