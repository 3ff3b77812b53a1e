"""Fills ``policy.json`` from a policy's configuration, its world, and what was measured."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import UTC, datetime

import mujoco
import numpy as np

from service.base.version import __version__, git_commit
from service.config import WorldConfig
from service.config.robot import Numbers, RobotConfig
from service.envs.batch import DISPLACEMENT_M, MAX_TURN_RAD, WIDTH_CHANGE_M, WorldBatch
from service.envs.observations import (
    COMMAND,
    COMMAND_PREFIX,
    DELAY,
    PAIR,
    SCALAR,
    VECTOR,
    Entry,
    Kind,
    ObservationLayout,
    layouts,
)
from service.envs.reach import Reach
from service.envs.robot import described
from service.envs.scene import FIXTURE_PREFIX
from service.export.description import (
    ActionEntry,
    ArrayEntry,
    Box,
    Clips,
    Description,
    FieldEntry,
    Fingers,
    FixtureEntry,
    Home,
    Made,
    NetworkEntry,
    Reachable,
    TrainedObject,
    WorldFrame,
)
from service.export.measurements import Measured
from service.export.networks import Network
from service.export.parity import Differences

_COMPONENTS: Mapping[Kind, tuple[str, ...]] = {
    VECTOR: ("x", "y", "z"),
    PAIR: ("left", "right"),
    SCALAR: ("value",),
    COMMAND: ("x", "y", "z", "width"),
}
_MEANINGS = {
    "effector": "the tip: the point between the fingertips",
    "fingers": "distance of each fingertip from the middle; 0 is closed, their sum is the width",
    "object": "centre of the object; its orientation is not seen",
    "object_from_effector": "object minus effector",
    "goal": "where the object's centre should be",
    DELAY: "by how many steps the positions above are late, or commands are carried out late; 0 for neither",
}
_COMMAND_MEANING = "the action sent {} ago, clipped to [-1, 1]; 0 where there was none yet"
_ORIENTATIONS = {
    "down": "the gripper points straight down and does not turn: the left finger is on the side of negative y",
    "down_any_turn": "the gripper points straight down; its turn about the vertical is not controlled",
    "free": "the gripper's orientation is not controlled",
}


def describe(
    name: str,
    world: WorldConfig,
    networks: Mapping[str, tuple[Network, Differences]],
    measured: Measured,
    *,
    format_name: str,
    task: str | None,
    success_distance_m: float,
    digests: Mapping[str, str],
) -> Description:
    """Describe an exported policy.

    Args:
        name: of the policy, such as ``panda-cube@1``.
        world: that it plays in: that of the run, or of its task.
        networks: by the names of their files, with what the parity test found.
        measured: in that world.
        format_name: of the files.
        task: of an orchestrator.
        success_distance_m: in that world.
        digests: sha256 of the parameters that went in.
    """
    robot, seen, workspace = described(world), layouts(world), world.workspace
    with WorldBatch(world, 1) as worlds:
        joints = dict(zip(robot.joints, map(float, worlds.joints[0]), strict=True))
        effector_m, reach, fixtures = worlds.ee_position[0], worlds.reach, _fixtures(worlds.model)
        width_m = float(worlds.robot.openings(worlds.states[:, worlds.layout["fingers"]]).sum())
    return Description(
        name=name,
        kind="bob" if task is None else "orchestrator",
        task=task,
        format=format_name,
        made=Made(
            tandem=__version__,
            git_commit=git_commit(),
            created=datetime.now(UTC).isoformat(timespec="seconds"),
            sha256=dict(digests),
        ),
        rate_hz=1.0 / (world.physics_step_s * world.num_substeps),
        networks=tuple(_network(file, *found) for file, found in networks.items()),
        observation=_fields(seen.bob),
        observation_size=seen.bob.size,
        positions_size=seen.positions.size,
        action=_action(),
        command=_command(world, robot),
        frame=WorldFrame(
            origin="the table top, in the middle of the table's width; of the Panda 0.6 m in front of its base",
            axes="x away from the robot's base, y to the robot's left, z up",
            base_position_m=robot.base_position_m,
            base_turn_rad=robot.base_turn_rad,
        ),
        tip=robot.effector,
        tip_orientation=_ORIENTATIONS[robot.orientation],
        home=Home(joints=joints, effector_m=_vector(effector_m), width_m=width_m),
        clips=Clips(
            lowest_m=robot.lowest_m,
            max_turn_rad=MAX_TURN_RAD,
            width_m=(0.0, robot.opening_m if world.gripper == "free" else 0.0),
            reach=_reachable(reach),
        ),
        gripper=Fingers(
            opening_m=robot.opening_m,
            max_force_n=_each(robot.finger_max_force, robot),
            stiffness=_each(robot.finger_stiffness, robot),
            damping=_each(robot.finger_damping, robot),
            coupling="each finger has a servo of its own, and all are sent to the same share of their way: they press "
            "with equal force, and nothing holds them at equal distances from the middle",
        ),
        workspace=Box(lower_m=workspace.lower_m, upper_m=workspace.upper_m),
        object=TrainedObject(
            shape=world.shape.shape,
            extent_m=world.shape.extent_m,
            mass_kg=world.object_mass_kg,
            friction=world.friction,
            pad_friction=world.pad_friction,
        ),
        fixtures=fixtures,
        success_distance_m=success_distance_m,
        measured=measured,
        tolerated_late_steps=measured.tolerated_late_steps,
    )


def _fixtures(model: mujoco.MjModel) -> tuple[FixtureEntry, ...]:
    """Fixtures that do not move from episode to episode."""
    data, found = mujoco.MjData(model), []
    mujoco.mj_kinematics(model, data)
    for geom in range(model.ngeom):
        name = model.geom(geom).name
        if not name.startswith(FIXTURE_PREFIX) or model.body_mocapid[model.geom_bodyid[geom]] >= 0:
            continue
        turn, (middle, half) = data.geom_xmat[geom].reshape(3, 3), model.geom_aabb[geom].reshape(2, 3)
        middle, half = data.geom_xpos[geom] + turn @ middle, np.abs(turn) @ half
        corners = _vector((middle - half).round(6)), _vector((middle + half).round(6))
        found.append(FixtureEntry(name=name.removeprefix(FIXTURE_PREFIX), lower_m=corners[0], upper_m=corners[1]))
    return tuple(found)


def _network(file: str, network: Network, differences: Differences) -> NetworkEntry:
    return NetworkEntry(
        file=file,
        title=network.title,
        inputs=tuple(ArrayEntry(name=name, shape=(size,)) for name, size in network.inputs.items()),
        outputs=tuple(ArrayEntry(name=name, shape=shape) for name, shape in network.outputs.items()),
        max_abs_difference=differences.usual,
        max_abs_difference_extreme=differences.extreme,
    )


def _fields(layout: ObservationLayout) -> tuple[FieldEntry, ...]:
    return tuple(_field(layout, entry) for entry in layout.entries)


def _field(layout: ObservationLayout, entry: Entry) -> FieldEntry:
    is_command = entry.name.startswith(COMMAND_PREFIX)
    age = entry.name.removeprefix(COMMAND_PREFIX)
    ago = "1 step" if age == "1" else f"{age} steps"
    return FieldEntry(
        name=entry.name,
        first=layout[entry.name].start,
        components=_COMPONENTS[entry.kind],
        unit=entry.unit,
        frame="world" if entry.kind == VECTOR else None,
        meaning=_COMMAND_MEANING.format(ago) if is_command else _MEANINGS.get(entry.name, entry.name.replace("_", " ")),
    )


def _action() -> tuple[ActionEntry, ...]:
    moves = [
        ActionEntry(name=axis, unit="m", full=DISPLACEMENT_M, meaning=f"way along {axis} from the tip to its set-point")
        for axis in _COMPONENTS[VECTOR]
    ]
    width = ActionEntry(
        name="width",
        unit="m",
        full=WIDTH_CHANGE_M,
        meaning="change of the gripper's width from what it is now; positive opens",
    )
    return (*moves, width)


def _command(world: WorldConfig, robot: RobotConfig) -> tuple[str, ...]:
    step_ms = 1e3 * world.physics_step_s * world.num_substeps
    widest_m = robot.opening_m if world.gripper == "free" else 0.0
    return (
        "clip the action to [-1, 1]; the networks have done so",
        f"set-point = tip as measured now + {DISPLACEMENT_M:g} m x (x, y, z): not from the last set-point",
        f"raise a set-point below {robot.lowest_m:g} m to that height; move one out of reach to the nearest in reach",
        f"width = width as measured now + {WIDTH_CHANGE_M:g} m x width, clipped to 0 to {widest_m:g} m, half of it for "
        "each finger",
        f"hold both for {step_ms:g} ms, then observe again: the arm covers a part of the way only, see measured",
    )


def _reachable(reach: Reach) -> Reachable | None:
    if not np.isfinite(reach.furthest).all():
        return None
    x, y = map(float, reach.axis)
    return Reachable(
        axis_m=(x, y),
        height_m=tuple(map(float, reach.height)),
        nearest_m=tuple(map(float, reach.nearest)),
        furthest_m=tuple(map(float, reach.furthest)),
    )


def _each(value: Numbers, robot: RobotConfig) -> tuple[float, ...]:
    return value if isinstance(value, tuple) else (value,) * len(robot.fingers)


def _vector(values: np.ndarray) -> tuple[float, float, float]:
    x, y, z = map(float, values)
    return x, y, z
