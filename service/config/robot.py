"""Descriptions of robots: a model file of the user's, and what a world has to know of it besides."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import Field, ValidationError, model_validator

from service.base.errors import ConfigError
from service.base.parsing import NAME
from service.config.frozen import FrozenModel, first_error
from service.config.model_files import Vector, absolute, file_digest
from service.config.tree import read_yaml

Quaternion = tuple[float, float, float, float]
_Number = Annotated[float, Field(ge=0.0)]
Numbers = _Number | tuple[_Number, ...]
"""One for all joints, or one each."""


class EffectorConfig(FrozenModel):
    """The end effector: the point between the fingertips, where things are held.

    Its z axis points out of the gripper, and its y axis from the right finger to the left one.
    """

    frame: str = Field(description="name of a site or body of the model that it is fixed to")
    position_m: Vector = Field((0.0, 0.0, 0.0), description="in that frame")
    quaternion: Quaternion = Field((1.0, 0.0, 0.0, 0.0), description="w x y z; its rotation in that frame")

    @model_validator(mode="after")
    def _turns(self) -> Self:
        if not any(self.quaternion):
            raise ValueError("quaternion: all four numbers are 0; no rotation is 1 0 0 0")
        return self


class PadConfig(FrozenModel):
    """A capsule that a finger holds things with."""

    start_m: Vector = Field(description="one end of its axis, in the frame of the finger's body")
    end_m: Vector = Field(description="its other end, in the frame of the body")
    radius_m: float = Field(gt=0.0, description="of its round ends")


class FingerConfig(FrozenModel):
    """A finger that one joint moves; what hangs on it moves along."""

    joint: str = Field(description="name of the joint that moves it")
    closed: float = Field(description="value of the joint where the gripper is closed, rad or m")
    open: float = Field(description="where it is open")
    side: Literal["left", "right", "both"] = Field(
        "both", description="that it is on; both: a jaw against a fixed one, or one of three fingers"
    )
    pads: tuple[PadConfig, ...] = Field(
        (),
        description="touch instead of the finger's own shapes. Two upright capsules hold a cube better than meshes do, "
        "at less cost and with a longer physics step; without any, meshes want steps of 2 ms",
    )

    @model_validator(mode="after")
    def _moves(self) -> Self:
        if self.closed == self.open:
            raise ValueError(f"finger {self.joint!r}: closed and open are both {self.open:g}; then it does not move")
        return self


class HandConfig(FrozenModel):
    """A hand with a model file of its own."""

    model: str = Field(description="MJCF or URDF file, as for the robot")
    at: str = Field(description="site or body of the robot's model that the hand is put on")
    model_sha256: str | None = Field(None, description="of that file, when it was read first")


class RobotConfig(FrozenModel):
    """A serial arm of hinges and slides with a gripper.

    The names are those in the model. Its own actuators, sensors and contacts are left out: every joint gets a position
    servo, and only the gripper touches anything.
    """

    name: str = Field(pattern=f"^{NAME}$")
    model: str | None = Field(
        None,
        description="MJCF or URDF file, from where the description is; package:NAME/FILE for one in a Python package. "
        "None: built in",
    )
    model_sha256: str | None = Field(None, description="of that file, when it was read first")
    root: str | None = Field(None, description="body of the model that the robot begins with; None: its only one")
    hand: HandConfig | None = None
    base_position_m: Vector = Field((0.0, 0.0, 0.0), description="of the root, from the table's origin")
    base_turn_rad: float = Field(0.0, description="turn of the root about the vertical")
    joints: tuple[str, ...] = Field(min_length=3, description="of the arm, from the base to the end effector")
    effector: EffectorConfig
    fingers: tuple[FingerConfig, ...] = Field(min_length=1)
    opening_m: float = Field(gt=0.0, le=0.5, description="between the fingertips where the gripper is open")
    home: tuple[float, ...] = Field(description="posture of the arm, rad or m, as it is in the middle of its work")
    orientation: Literal["down", "down_any_turn", "free"] = Field(
        "down",
        description="of the gripper. down: it points down and does not turn; down_any_turn: it points down, for arms "
        "of five joints; free: nothing is asked of it",
    )
    stiffness: Numbers = Field(2000.0, description="of the joints' servos, N m/rad or N/m")
    damping: Numbers = Field(
        100.0, description="of the same; stiffness / damping is how fast an arm follows, 20 to 25 1/s are usual"
    )
    max_force: Numbers = Field(100.0, description="of the same, N m or N")
    armature: Numbers | None = Field(None, description="inertia of the motors, kg m2 or kg; None: the model's")
    friction_loss: Numbers | None = Field(None, description="dry friction of the joints, N m or N; None: the model's")
    finger_stiffness: Numbers = Field(1000.0, description="N/m, or Nm/rad of a hinge")
    finger_damping: Numbers = Field(25.0, description="Ns/m, or Nms/rad of a hinge")
    finger_max_force: Numbers = Field(40.0, description="N, or Nm of a hinge")
    finger_armature: Numbers | None = None
    finger_friction_loss: Numbers | None = None
    touching: tuple[str, ...] = Field(
        (), description="further bodies that touch object and table, besides the fingers and the one they are on"
    )
    lowest_m: float = Field(0.012, ge=0.0, le=0.2, description="least height of a commanded end effector")

    @model_validator(mode="after")
    def _same_numbers(self) -> Self:
        for field, expected in (
            *((name, len(self.joints)) for name in ("home", *_OF_JOINTS)),
            *((name, len(self.fingers)) for name in _OF_FINGERS),
        ):
            value = getattr(self, field)
            if isinstance(value, tuple) and len(value) != expected:
                what = "fingers" if field in _OF_FINGERS else "joints"
                raise ValueError(f"{field} has {len(value)} numbers, there are {expected} {what}")
        names = [*self.joints, *(finger.joint for finger in self.fingers)]
        if twice := [name for name in names if names.count(name) > 1]:
            raise ValueError(f"joint {twice[0]!r} is named twice")
        return self


_OF_JOINTS = ("stiffness", "damping", "max_force", "armature", "friction_loss")
_OF_FINGERS = ("finger_stiffness", "finger_damping", "finger_max_force", "finger_armature", "finger_friction_loss")


def read_robot(path: Path) -> RobotConfig:
    """Read a description of a robot, with the digests of its model files.

    Raises:
        ConfigError: no such file, no description, or no such model.
    """
    try:
        robot = RobotConfig.model_validate(read_yaml(path))
    except ValidationError as error:
        raise ConfigError(f"robot {path}: {first_error(error)}") from None
    if robot.model is None:
        raise ConfigError(f"robot {path}: model is missing: name an MJCF or URDF file")
    found = {**_found(robot.model, path.parent), "hand": robot.hand}
    if robot.hand is not None:
        found["hand"] = robot.hand.model_copy(update=_found(robot.hand.model, path.parent))
    return robot.model_copy(update=found)


def _found(name: str, directory: Path) -> dict[str, Any]:
    """The model's absolute path, or its package, and the digest of the file there."""
    name = absolute(name, directory)
    return {"model": name, "model_sha256": file_digest(name)}
