"""Options of films that several commands share, and what was typed for them."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from service.base.errors import TandemError

if TYPE_CHECKING:
    from service.base.types import StateArray
    from service.config import WorldConfig
    from service.envs.sampling import GoalKind
    from service.media.video import FilmOptions

SizeOption = Annotated[str, typer.Option("--size", metavar="WxH", help="Of the whole film, pixels.")]
CameraOption = Annotated[
    str,
    typer.Option(
        "--camera",
        metavar="VIEW",
        help="front, far, close, side, behind or top; also, or after it, azimuth=DEG,elevation=DEG,distance=M.",
    ),
]
SpeedOption = Annotated[float, typer.Option("--speed", help="0.5: half as fast as in the world.")]
GoalsOption = Annotated[
    str | None,
    typer.Option(
        "--goals",
        metavar="KIND|POINTS",
        help="table, air, volume or mixed; or points in metres, such as '0.1,0,0.2; 0,-0.1,0.025'.",
    ),
]
OutOption = Annotated[Path, typer.Option("--out", metavar="FILE", help="Film to write: .mp4 or .gif.")]
SIZE, CAMERA, SPEED, OUT = "1280x720", "front", 1.0, Path("video.mp4")

_SIZES, _SPEEDS = (64, 4096), (0.05, 20.0)


def film_options(size: str, camera: str, speed: float, out: Path) -> FilmOptions:
    """How a film shall look.

    Raises:
        TandemError: a size, camera, speed or end of the file's name that no film has.
    """
    from service.envs.rendering.camera import parse_view
    from service.media.encoding import check_format
    from service.media.video import FilmOptions

    check_format(out)
    found = re.fullmatch(r"([0-9]{1,5})x([0-9]{1,5})", size)
    width, height = map(int, found.groups()) if found else (0, 0)
    if any(side % 2 or not _SIZES[0] <= side <= _SIZES[1] for side in (width, height)):
        raise TandemError(
            f"--size {size!r}: write WIDTHxHEIGHT, even numbers from {_SIZES[0]} to {_SIZES[1]}, such as 1280x720"
        )
    if not _SPEEDS[0] <= speed <= _SPEEDS[1]:
        raise TandemError(f"--speed {speed:g}: give {_SPEEDS[0]:g} to {_SPEEDS[1]:g}; 1 is as fast as in the world")
    return FilmOptions(width, height, parse_view(camera), speed)


def parse_goals(text: str, world: WorldConfig) -> GoalKind | StateArray:
    """A kind of random goals, or (N, 3) goals in metres.

    Raises:
        TandemError: neither; or a goal outside of the workspace, or inside a fixture.
    """
    import numpy as np

    from service.envs.sampling import GOAL_KINDS, check_goals, inside_fixtures
    from service.generator.validity import in_workspace

    for kind in GOAL_KINDS:
        if text.strip() == kind:
            check_goals(kind, world)
            return kind
    try:
        points = np.array([[float(part) for part in point.split(",")] for point in text.strip("; ").split(";")])
    except ValueError:
        points = np.empty(0)
    if points.shape[1:] != (3,) or not np.isfinite(points).all():
        raise TandemError(
            f"--goals {text!r}: write one of {', '.join(GOAL_KINDS)}, or points x,y,z in metres with ; between"
        )
    for point in points[~in_workspace(points, world.workspace)]:
        low, high = (_numbers(corner) for corner in (world.workspace.lower_m, world.workspace.upper_m))
        raise TandemError(f"--goals: {_numbers(point)} is outside of the workspace, ({low}) to ({high}) m")
    for point in points[inside_fixtures(points, world)]:
        raise TandemError(
            f"--goals: at {_numbers(point)} the object would be inside a fixture, or the upright box around it"
        )
    return points


def _numbers(point: Iterable[float]) -> str:
    return ", ".join(f"{each:g}" for each in point)
