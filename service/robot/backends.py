"""Back-ends by name: what makes a robot, and what sees its objects, of a few words and parameters."""

from __future__ import annotations

import importlib
import inspect
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

from pydantic import Field, ValidationError

from service.base.errors import TandemError, did_you_mean, one_line
from service.base.types import StateArray
from service.config.frozen import FrozenModel, first_error
from service.config.load import explained
from service.config.tree import read_yaml
from service.config.world import WorldConfig
from service.robot.disturbed import DisturbanceConfig, DisturbedPoses, DisturbedRobot
from service.robot.interface import ObjectPose, PoseSource, RobotInterface

BACKENDS = {
    "mujoco": "service.robot.mujoco_robot:connect",
    "pybullet": "service.robot.pybullet_robot:connect",
    "franka": "service.robot.franka_robot:connect",
}
"""Where the function of each is, as ``module:function``: of a policy's world and parameters to a ``Backend``."""


class Simulator(Protocol):
    """What a simulated robot offers besides: new starts, and the truth."""

    def reset(self, object_m: StateArray) -> None:
        """Put the arm to its start with an open gripper, and K objects on the table at (3 K,) metres; time goes on.

        How high they lie is the simulator's to say: its objects may be others than those of the policy's world.
        """

    def object_position(self) -> StateArray:
        """(3 K,) where the objects are in truth, metres."""


class ExactPoses:
    """Sees the objects of a simulator as they are, at every moment."""

    def __init__(self, robot: RobotInterface, simulator: Simulator) -> None:
        self._robot, self._simulator = robot, simulator

    def read(self) -> ObjectPose:
        """Their poses now."""
        return ObjectPose(self._robot.now_s(), self._simulator.object_position())

    def close(self) -> None:
        """Nothing is left behind."""


@dataclass(frozen=True, slots=True)
class Backend:
    """A robot, and what sees its objects."""

    robot: RobotInterface
    poses: PoseSource
    simulator: Simulator | None = None
    """None for a robot that people have to put back by hand."""

    def begin(self, object_m: StateArray) -> None:
        """Begin an episode, in a simulator with K objects at (3 K,) metres; nothing is on its way from the last one."""
        if self.simulator is not None:
            self.simulator.reset(object_m)
        for part in (self.robot, self.poses):
            if isinstance(part, (DisturbedRobot, DisturbedPoses)):
                part.forget()

    def close(self) -> None:
        """Let go of both, of the robot first."""
        try:
            self.robot.close()
        finally:
            self.poses.close()


class BackendConfig(FrozenModel):
    """A back-end and its parameters, as a YAML file has them."""

    backend: str = Field(description="mujoco, pybullet, franka, or module:function of your own")
    name: str | None = Field(None, description="of this robot, in calibrations and logs; None: the back-end's")
    parameters: dict[str, Any] = Field(default_factory=dict, description="of the back-end")
    disturbance: DisturbanceConfig = DisturbanceConfig()

    @property
    def label(self) -> str:
        """Name of the robot."""
        return self.name or self.backend


def read_backend(reference: str) -> BackendConfig:
    """The back-end that ``--robot`` names.

    Args:
        reference: a name in ``BACKENDS``, ``module:function``, or a YAML file.

    Raises:
        TandemError: none of these, or a file with something else in it.
    """
    if reference in BACKENDS or (":" in reference and not Path(reference).exists()):
        return BackendConfig(backend=reference)
    if not Path(reference).is_file():
        if Path(reference).suffix or "/" in reference:
            raise TandemError(f"no file {reference}: name a YAML file of a robot, or one of {', '.join(BACKENDS)}")
        raise TandemError(
            f"unknown robot {reference!r}: name {', '.join(BACKENDS)}, module:function of your own, or a YAML file"
            f"{did_you_mean(reference, BACKENDS)}"
        )
    try:
        return BackendConfig.model_validate(read_yaml(Path(reference)))
    except ValidationError as error:
        raise TandemError(f"robot {reference}: {explained(error, BackendConfig)}") from None


def file_of(config: BackendConfig) -> str | None:
    """The file of a user's back-end, once it is connected; None of ours."""
    module = sys.modules.get(config.backend.partition(":")[0])
    return None if config.backend in BACKENDS else getattr(module, "__file__", None)


def connect(config: BackendConfig, world: WorldConfig, *, seed: int = 0) -> Backend:
    """Make a back-end, disturbed as its configuration asks.

    Args:
        config: which one.
        world: of the policy; simulators build it, others take from it what they need.
        seed: of noise.

    Raises:
        TandemError: no such back-end, what it needs is not installed, or it does not answer.
    """
    module, _, name = BACKENDS.get(config.backend, config.backend).partition(":")
    if module.endswith(".py"):
        raise TandemError(f"robot {config.backend!r}: write it as Python imports it, {Path(module).stem}:{name}")
    try:
        made = getattr(importlib.import_module(module), name)(world, config.parameters)
    except ValidationError as error:
        raise TandemError(f"robot {config.backend}: parameters: {first_error(error)}") from None
    except TandemError:
        raise
    except Exception as error:  # it may be the user's own code
        words = one_line(f"{type(error).__name__}: {error}", 300)
        raise TandemError(f"robot {config.backend!r} cannot be made: {words}") from error
    if not isinstance(made, Backend):
        raise TandemError(
            f"robot {config.backend!r} made {type(made).__name__}; return a service.robot.backends.Backend"
        )
    for part, kind in ((made.robot, RobotInterface), (made.poses, PoseSource)):
        methods = [name for name, each in vars(kind).items() if inspect.isfunction(each) and not name.startswith("_")]
        if missing := [name for name in methods if not callable(getattr(part, name, None))]:
            raise TandemError(
                f"robot {config.backend!r}: {type(part).__name__} has no {', '.join(missing)}, which "
                f"service.robot.interface.{kind.__name__} asks for"
            )
    if config.disturbance == DisturbanceConfig():
        return made
    poses = DisturbedPoses(made.poses, made.robot.now_s, config.disturbance, num_objects=world.num_objects, seed=seed)
    return replace(made, robot=DisturbedRobot(made.robot, config.disturbance), poses=poses)
