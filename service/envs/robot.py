"""Robots: put into a scene under construction, and what a batch of worlds asks of them."""

from __future__ import annotations

import re
from itertools import chain as joined
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from service.base.errors import ConfigError
from service.base.types import BoolArray, StateArray
from service.config import WorldConfig
from service.config.model_files import model_file
from service.config.robot import Numbers, PadConfig, RobotConfig
from service.envs import panda
from service.envs.kinematics import Chain
from service.envs.objects import GRIPPER_BIT, add_finger_sensors, grip, object_names, slide

_PREFIX, _HAND_PREFIX = "robot/", "hand/"
"""Begin the names of all that comes from a file, so that none is that of something in the scene; a hand's has both."""
_SIDES = ("left", "right")
_ROS_ADDRESS = re.compile(r"package:/+([^/]+)/(.+)")
_BEYOND = 1e-4
"""Of a joint's range, rad or m, that is rounding."""
_HIDDEN = 4
"""Group of what is not drawn."""


def described(config: WorldConfig) -> RobotConfig:
    """The description of a world's robot."""
    return panda.PANDA if config.robot == "panda" else config.robot


def add_robot(spec: mujoco.MjSpec, config: WorldConfig) -> None:
    """Add the arm, its gripper, its servos and the sensors of its fingers to a scene under construction.

    Actuators: joints of the arm (rad or m), then fingers, as in the description. The arm has no weight: a robot's own
    controller compensates gravity, so the scene has none (see ``scene.build_spec``).

    Raises:
        ConfigError: the model cannot be read, or has not what the description names.
    """
    robot = described(config)
    if config.robot == "panda":
        panda.add_panda(spec, pad_friction=config.pad_friction, physics_step_s=config.physics_step_s)
    else:
        _add_from_files(spec, robot)
    joints = [_find_joint(spec, robot, name) for name in robot.joints]
    fingers = [_find_joint(spec, robot, finger.joint) for finger in robot.fingers]
    _check_joints(spec, robot, joints, fingers)
    _check_effector(spec, robot, config)
    for group, prefix in ((joints, ""), (fingers, "finger_")):
        for index, joint in enumerate(group):
            for name in ("armature", "friction_loss"):
                if (value := getattr(robot, f"{prefix}{name}")) is not None:
                    setattr(joint, name.replace("_", ""), _number(value, index))
            names = (f"{prefix}{name}" for name in ("stiffness", "damping", "max_force"))
            _add_servo(spec, joint, *(_number(getattr(robot, name), index) for name in names))
    if config.robot != "panda":
        _let_touch(spec, robot, [joint.parent for joint in fingers], config.pad_friction)
    add_finger_sensors(spec, [joint.parent.name for joint in fingers], object_names(config))


class Robot:
    """What a batch of worlds asks of its robot, a compiled one.

    Args:
        config: the world.
        model: that was compiled of it.
    """

    def __init__(self, config: WorldConfig, model: mujoco.MjModel) -> None:
        robot = described(config)
        self.num_joints, self.num_fingers = len(robot.joints), len(robot.fingers)
        self.opening_m = robot.opening_m
        """Between the fingertips where the gripper is open."""
        self.widest_m = robot.opening_m if config.gripper == "free" else 0.0
        """The same, or 0 for a gripper that is blocked."""
        prefix = _prefix(robot)
        self.arm = Chain(
            model,
            [prefix + name for name in robot.joints],
            prefix + robot.effector.frame,
            position=robot.effector.position_m,
            quaternion=robot.effector.quaternion,
            home=robot.home,
            orientation=robot.orientation,
        )
        _check_fingers(model, robot)
        joints = [model.joint(prefix + finger.joint).id for finger in robot.fingers]
        self.turning: BoolArray = model.jnt_type[joints] == mujoco.mjtJoint.mjJNT_HINGE
        """(F,) fingers that turn, so that their servos have a torque; those of the others have a force."""
        self._closed = np.array([finger.closed for finger in robot.fingers])
        self._travel = np.array([finger.open for finger in robot.fingers]) - self._closed
        on_side = np.array([[finger.side in (side, "both") for side in _SIDES] for finger in robot.fingers])
        self._sides: BoolArray = on_side
        """(F, 2) whether a finger is on the left, and on the right."""
        self._openings: StateArray = on_side / np.maximum(1, on_side.sum(axis=0)) * self.opening_m / 2
        self._openings /= self._travel[:, None]

    def openings(self, fingers: StateArray) -> StateArray:
        """(N, 2) distance of the left and right fingertip from the middle, metres, for (N, F) values of fingers."""
        return self.opening_speeds(fingers - self._closed)

    def opening_speeds(self, fingers: StateArray) -> StateArray:
        """(N, 2) the same for (N, F) velocities, m/s."""
        speeds: StateArray = (fingers[:, :, None] * self._openings).sum(axis=1)
        return speeds

    def finger_values(self, width: StateArray) -> StateArray:
        """(N, F) values of fingers (rad or m) that open the gripper to (N,) widths, metres."""
        values: StateArray = self._closed + (width / self.opening_m)[:, None] * self._travel
        return values

    def contacts(self, touches: BoolArray) -> BoolArray:
        """(N, 2 K) whether a left and a right finger touches each object, for (N, K F) fingers that do."""
        sides: BoolArray = np.matmul(touches.reshape(len(touches), -1, self.num_fingers), self._sides)
        return sides.reshape(len(touches), -1)


def _add_from_files(spec: mujoco.MjSpec, robot: RobotConfig) -> None:
    assert robot.model is not None
    arm = _read(robot.model, robot.model_sha256, spec)
    roots = arm.worldbody.bodies
    if robot.root is None and len(roots) != 1:
        found = ", ".join(body.name for body in roots)
        raise ConfigError(
            f"robot {robot.name}: {robot.model} has {len(roots)} bodies at its top ({found}): name one as root"
        )
    root = roots[0] if robot.root is None else _there(arm.body(robot.root), robot, f"body {robot.root!r}")
    root.pos = (0.0, 0.0, 0.0)
    half = robot.base_turn_rad / 2
    frame = spec.worldbody.add_frame(pos=robot.base_position_m, quat=(np.cos(half), 0.0, 0.0, np.sin(half)))
    frame.attach_body(root, _PREFIX, "")
    if robot.hand is not None:
        hand = _read(robot.hand.model, robot.hand.model_sha256, spec)
        at = _PREFIX + robot.hand.at
        site = spec.site(at)
        body = site or _there(spec.body(at), robot, f"site or body {robot.hand.at!r} to put the hand on")
        place = {"site": site} if site is not None else {"frame": body.add_frame()}
        spec.attach(hand, prefix=_PREFIX + _HAND_PREFIX, **place)


def _there(found: Any, robot: RobotConfig, what: str) -> Any:
    """What was found in a robot's model under a name of its description.

    Raises:
        ConfigError: nothing was.
    """
    if found is None:
        raise ConfigError(f"robot {robot.name}: no {what} in its model")
    return found


def _read(name: str, sha256: str | None, scene: mujoco.MjSpec) -> mujoco.MjSpec:
    """A model without what a scene has of its own."""
    path = model_file(name, sha256)
    try:
        spec = mujoco.MjSpec.from_file(str(path))
    except ValueError as error:
        raise ConfigError(f"{path}: MuJoCo cannot read it: {' '.join(str(error).split())}") from None
    for group in (spec.actuators, spec.sensors, spec.keys, spec.cameras, spec.lights, spec.worldbody.geoms):
        for each in list(group):
            spec.delete(each)
    for site in spec.sites:
        site.group = _HIDDEN
    _find_meshes(spec, path)
    _take_settings(spec, scene)
    return spec


def _find_meshes(spec: mujoco.MjSpec, path: Path) -> None:
    """Replace ROS's addresses of meshes by files, in the directory above the model that has the package's name."""
    for mesh in spec.meshes:
        if (address := _ROS_ADDRESS.fullmatch(mesh.file)) is None:
            continue
        package, file = address.groups()
        home = next((above for above in path.absolute().parents if above.name == package), None)
        if home is None:
            raise ConfigError(
                f"{path}: its mesh {file} is in the ROS package {package!r}, and no directory above it has that name: "
                "put it there, or write where its meshes are from the model's file"
            )
        mesh.file = str(home / file)


def _take_settings(spec: mujoco.MjSpec, scene: mujoco.MjSpec) -> None:
    """Give a model the scene's settings of physics and pictures, or MuJoCo warns of every one that differs."""
    visual = ("global_", "headlight", "map", "quality", "rgba", "scale")
    groups = [(spec.option, scene.option), (spec.stat, scene.stat)]
    for theirs, ours in groups + [(getattr(spec.visual, name), getattr(scene.visual, name)) for name in visual]:
        for name in dir(ours):
            if not name.startswith("_"):
                setattr(theirs, name, getattr(ours, name))


def _find_joint(spec: mujoco.MjSpec, robot: RobotConfig, name: str) -> mujoco.MjsJoint:
    prefix = _prefix(robot)
    known = ", ".join(each.name.removeprefix(prefix) for each in spec.joints)
    joint: mujoco.MjsJoint = _there(spec.joint(prefix + name), robot, f"joint {name!r}, only {known},")
    if joint.type not in (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE):
        raise ConfigError(f"robot {robot.name}: joint {name!r} is neither a hinge nor a slide")
    return joint


def _check_joints(
    spec: mujoco.MjSpec, robot: RobotConfig, joints: list[mujoco.MjsJoint], fingers: list[mujoco.MjsJoint]
) -> None:
    """Refuse joints without an actuator, and an order that is not the model's."""
    there, named = ([each.name.removeprefix(_PREFIX) for each in group] for group in (spec.joints, [*joints, *fingers]))
    if there != named:
        raise ConfigError(
            f"robot {robot.name}: joints and fingers are not all of the model's in their order, {', '.join(there)}: "
            "name them so, or weld those that do not move"
        )


def _check_effector(spec: mujoco.MjSpec, robot: RobotConfig, config: WorldConfig) -> None:
    frame = _prefix(robot) + robot.effector.frame
    _there(spec.site(frame) or spec.body(frame), robot, f"site or body {robot.effector.frame!r}, the effector's frame,")
    width_m = max(body.extent_m[1] for body in config.bodies)
    if config.gripper == "free" and width_m >= robot.opening_m:
        raise ConfigError(
            f"robot {robot.name}: its gripper opens to {robot.opening_m:g} m, and along y an object is {width_m:g} m "
            "wide: make it smaller, turn it, or set world.gripper=blocked"
        )


def _check_fingers(model: mujoco.MjModel, robot: RobotConfig) -> None:
    """Refuse fingers that cannot open as far as the description says."""
    for finger in robot.fingers:
        joint = model.joint(_prefix(robot) + finger.joint)
        low, high = joint.range
        if model.jnt_limited[joint.id] and not low - _BEYOND <= finger.open <= high + _BEYOND:
            raise ConfigError(
                f"robot {robot.name}: finger {finger.joint!r} is described as open at {finger.open:g}, and its joint "
                f"goes from {low:g} to {high:g}: correct open, and opening_m with it"
            )


def _let_touch(spec: mujoco.MjSpec, robot: RobotConfig, fingers: list[mujoco.MjsBody], pad_friction: float) -> None:
    """Let the gripper's geoms touch object and table, and nothing else of the robot anything."""
    root = spec.body(fingers[0].name)
    while root.parent is not spec.worldbody and root.parent.name != "world":
        root = root.parent
    solid = {geom.id: geom for geom in root.find_all(mujoco.mjtObj.mjOBJ_GEOM) if geom.contype or geom.conaffinity}
    for geom in solid.values():
        geom.contype = geom.conaffinity = 0
    touching = [_there(spec.body(_PREFIX + name), robot, f"body {name!r}, of touching,") for name in robot.touching]
    others = touching + [finger.parent for finger in fingers]
    for geom in joined.from_iterable(body.geoms for body in others):
        if geom.id in solid:
            geom.contype = GRIPPER_BIT
            slide(geom)
    for finger, description in zip(fingers, robot.fingers, strict=True):
        own = [geom for geom in finger.find_all(mujoco.mjtObj.mjOBJ_GEOM) if geom.id in solid]
        if not (own or description.pads):
            raise ConfigError(
                f"robot {robot.name}: finger {description.joint!r} has no shape that touches anything: give it "
                "pads, or let its model have collision shapes"
            )
        for geom in [_add_pad(finger, pad) for pad in description.pads] or own:
            geom.contype = GRIPPER_BIT
            grip(geom, pad_friction)


def _add_pad(finger: mujoco.MjsBody, pad: PadConfig) -> mujoco.MjsGeom:
    return finger.add_geom(
        type=mujoco.mjtGeom.mjGEOM_CAPSULE,
        fromto=(*pad.start_m, *pad.end_m),
        size=(pad.radius_m, 0, 0),
        conaffinity=0,
        mass=0.0,
        group=3,
    )


def _add_servo(spec: mujoco.MjSpec, joint: mujoco.MjsJoint, stiffness: float, damping: float, max_force: float) -> None:
    servo = spec.add_actuator(name=joint.name, target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
    servo.set_to_position(kp=stiffness, kv=damping)
    servo.forcelimited, servo.forcerange = True, (-max_force, max_force)
    if joint.range[0] < joint.range[1]:
        servo.ctrllimited, servo.ctrlrange = True, joint.range


def _number(numbers: Numbers, index: int) -> float:
    return numbers[index] if isinstance(numbers, tuple) else numbers


def _prefix(robot: RobotConfig) -> str:
    """Begins the names of a robot's parts in a scene."""
    return _PREFIX if robot.model is not None else ""
