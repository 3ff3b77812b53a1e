"""``policy.json``: everything a bridge has to know of an exported policy."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import Field, ValidationError

from service.base.errors import ExportError
from service.base.files import os_errors, read_regular
from service.base.parsing import ParseError, parse_json
from service.config.frozen import FrozenModel
from service.config.robot import EffectorConfig, Vector
from service.export.measurements import Measured

FILE = "policy.json"
_MAX_BYTES = 4 * 1024 * 1024


class ArrayEntry(FrozenModel):
    """Input or output of a network: (N, ...) float32."""

    name: str
    shape: tuple[int, ...] = Field(description="without N")


class NetworkEntry(FrozenModel):
    """A network of the folder."""

    file: str
    title: str
    inputs: tuple[ArrayEntry, ...]
    outputs: tuple[ArrayEntry, ...]
    max_abs_difference: float = Field(
        description="of any output from the evaluator's policy, at recorded inputs and around them"
    )
    max_abs_difference_extreme: float = Field(description="the same at extreme inputs")


class FieldEntry(FrozenModel):
    """Some numbers of an observation that stand one after the other."""

    name: str
    first: int = Field(description="column of its first number, from 0")
    components: tuple[str, ...]
    unit: str
    frame: str | None = Field(description="of positions and displacements; None: of none")
    meaning: str


class ActionEntry(FrozenModel):
    """One number of an action, in [-1, 1]."""

    name: str
    unit: str
    full: float = Field(
        description="what 1 asks for, in the unit; the arm does not come so far in a step, see measured"
    )
    meaning: str


class WorldFrame(FrozenModel):
    """The frame of all positions."""

    origin: str
    axes: str
    base_position_m: Vector = Field(description="of the robot's root in it")
    base_turn_rad: float = Field(description="of the robot's root about the vertical")


class Home(FrozenModel):
    """Where episodes start."""

    joints: dict[str, float] = Field(description="rad or m")
    effector_m: Vector
    width_m: float = Field(description="between the fingertips")


class Reachable(FrozenModel):
    """Where set-points of the end effector are clipped to: distance from the base's axis, by height."""

    axis_m: tuple[float, float]
    height_m: tuple[float, ...]
    nearest_m: tuple[float, ...]
    furthest_m: tuple[float, ...]


class Clips(FrozenModel):
    """How the controller of the world clips what a policy asks for."""

    lowest_m: float = Field(description="least height of a set-point of the end effector")
    max_turn_rad: float = Field(description="most that a joint is asked to turn (or slide, m) in a step")
    width_m: tuple[float, float] = Field(description="least and greatest width that is set")
    reach: Reachable | None = Field(description="None: joint limits are all that holds the arm back")


class Fingers(FrozenModel):
    """The gripper, as it was in training."""

    opening_m: float
    max_force_n: tuple[float, ...] = Field(description="of each finger's servo, N (or N m); this is the grip's force")
    stiffness: tuple[float, ...] = Field(description="of the same, N/m or N m/rad")
    damping: tuple[float, ...]
    coupling: str = Field(description="how the fingers go together")


class Box(FrozenModel):
    """A box along the axes of the world."""

    lower_m: Vector
    upper_m: Vector


class TrainedObject(FrozenModel):
    """The object of training; its orientation is not observed."""

    shape: str
    extent_m: Vector
    mass_kg: float
    friction: float
    pad_friction: float = Field(description="of the fingertips on it")


class FixtureEntry(Box):
    """A part of what stands on the table and cannot be moved, by the upright box around it."""

    name: str = Field(description="of the task's, or NUMBER-PIECE of world.fixtures, both from 0")


class Made(FrozenModel):
    """Where an export comes from."""

    tandem: str
    git_commit: str | None
    created: str = Field(description="UTC, ISO 8601")
    sha256: dict[str, str] = Field(description="of the parameters that went in")


class Description(FrozenModel):
    """The content of ``policy.json``."""

    format_version: Literal[1] = 1
    name: str
    kind: Literal["bob", "orchestrator"]
    task: str | None = Field(description="that an orchestrator was trained for")
    format: str
    made: Made
    rate_hz: float = Field(description="of observations and actions")
    networks: tuple[NetworkEntry, ...]
    observation: tuple[FieldEntry, ...]
    observation_size: int
    positions_size: int = Field(description="the first numbers of an observation, all that primitives see")
    action: tuple[ActionEntry, ...]
    command: tuple[str, ...] = Field(description="how an action becomes set-points, in order")
    frame: WorldFrame
    tip: EffectorConfig = Field(description="the end effector: its place in a frame of the robot's model")
    tip_orientation: str
    home: Home
    clips: Clips
    gripper: Fingers
    workspace: Box = Field(description="in which goals and objects were in training")
    object: TrainedObject
    fixtures: tuple[FixtureEntry, ...] = Field(
        (), description="that stand where they stand in every episode; the box of the task box is elsewhere in each"
    )
    success_distance_m: float
    measured: Measured
    tolerated_late_steps: int


def read_description(folder: Path) -> Description:
    """Read the description in an exported folder.

    Raises:
        ExportError: it is none.
        StorageError: there is none.
    """
    path = folder / FILE
    with os_errors("read", path):
        data = read_regular(path, _MAX_BYTES, follow=True)
    try:
        return Description.model_validate(parse_json(data, path))
    except ParseError as error:
        raise ExportError(f"{path} is damaged: {error.reason}; export the policy again") from None
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        raise ExportError(f"{path} describes no exported policy: {where}: {first['msg']}; export it again") from None
