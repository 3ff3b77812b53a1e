"""Where pictures are taken from: named views, and angles and a distance of one's own."""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import dataclass, replace

import mujoco

from service.base.errors import TandemError

_HOW = "write a view, such as close, or numbers, such as azimuth=120,elevation=-30,distance=1.5, or both"


@dataclass(frozen=True, slots=True)
class CameraView:
    """Direction and distance from which a camera looks at a point."""

    azimuth_deg: float
    """Direction it looks in, seen from above: 180 at the robot from the front, 0 from behind it."""
    elevation_deg: float
    """How far it looks up; -90 straight down."""
    distance_m: float
    lookat_m: tuple[float, float, float] = (-0.12, 0.0, 0.18)

    def camera(self) -> mujoco.MjvCamera:
        """MuJoCo's camera of this view."""
        camera = mujoco.MjvCamera()
        camera.type = mujoco.mjtCamera.mjCAMERA_FREE
        camera.lookat, camera.distance = self.lookat_m, self.distance_m
        camera.azimuth, camera.elevation = self.azimuth_deg, self.elevation_deg
        return camera

    @property
    def position_m(self) -> tuple[float, float, float]:
        """Place of the camera, metres."""
        azimuth, elevation = math.radians(self.azimuth_deg), math.radians(self.elevation_deg)
        level = math.cos(elevation)
        forward = (level * math.cos(azimuth), level * math.sin(azimuth), math.sin(elevation))
        x, y, z = (at - self.distance_m * part for at, part in zip(self.lookat_m, forward, strict=True))
        return x, y, z


_WORKSPACE_M = (0.0, 0.0, 0.12)
VIEWS = {
    "front": CameraView(146.0, -21.0, 1.68, (-0.15, 0.0, 0.19)),
    "far": CameraView(146.0, -21.0, 2.6, (-0.25, 0.0, 0.1)),
    "close": CameraView(146.0, -26.0, 1.0, _WORKSPACE_M),
    "side": CameraView(90.0, -14.0, 1.5),
    "behind": CameraView(20.0, -34.0, 1.5, _WORKSPACE_M),
    "top": CameraView(180.0, -89.0, 1.2, (0.0, 0.0, 0.0)),
}
"""Views by the names that commands take."""
DEFAULT_VIEW = VIEWS["front"]
_NUMBERS = {
    "azimuth": ("azimuth_deg", -360.0, 360.0),
    "elevation": ("elevation_deg", -90.0, 90.0),
    "distance": ("distance_m", 0.2, 20.0),
}
"""Fields and ranges of the numbers that may be given."""


def parse_view(text: str) -> CameraView:
    """The view that ``close``, ``azimuth=120,distance=2`` or ``side,elevation=-30`` means.

    Raises:
        TandemError: an unknown name, or a number that is none or out of its range.
    """
    first, *rest = [part.strip() for part in text.split(",")]
    if "=" in first:
        first, rest = "front", [first, *rest]
    if first not in VIEWS:
        raise TandemError(f"camera {first!r}: there is none; {_HOW}; views are {', '.join(VIEWS)}")
    changes: dict[str, float] = {}
    for part in rest:
        key, _, value = part.partition("=")
        if key not in _NUMBERS:
            raise TandemError(f"camera {part!r}: {_HOW}")
        field, low, high = _NUMBERS[key]
        number = math.nan
        with suppress(ValueError):
            number = float(value)
        if not low <= number <= high:
            raise TandemError(f"camera {part!r}: give a number from {low:g} to {high:g}")
        changes[field] = number
    return replace(VIEWS[first], **changes)  # type: ignore[arg-type]
