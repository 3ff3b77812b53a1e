"""What a bridge must know of an exported policy: ``policy.json`` for programs, and the same as ``README.md``."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from datetime import UTC, datetime
from typing import Any

import mujoco
import numpy as np

from service.base.markdown import table
from service.base.tensors import digest_of
from service.base.types import FloatArray
from service.base.version import __version__, git_commit
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
    Layouts,
    layouts,
)
from service.envs.reach import Reach
from service.envs.robot import described
from service.envs.scene import FIXTURE_PREFIX
from service.envs.state_layout import OBSTACLE_PREFIX
from service.export.measurements import Measured, tolerated_late_steps
from service.export.networks import Network
from service.registry.loading import Trained

Description = dict[str, Any]
"""The content of ``policy.json``."""

_COMPONENTS: Mapping[Kind, tuple[str, ...]] = {
    VECTOR: ("x", "y", "z"),
    PAIR: ("left", "right"),
    SCALAR: ("value",),
    COMMAND: ("x", "y", "z", "width"),
}
_MEANINGS = {
    "effector": "the tip: the point between the fingertips",
    "fingers": "distance of each fingertip from the middle; 0 is closed, their sum is the width",
    "object": "its centre; its orientation is not seen",
    "object_from_effector": "its centre minus effector",
    "goal": "where its centre should be",
    DELAY: "by how many steps the positions above are late, or commands are carried out late; 0 for neither",
}
_COMMAND_MEANING = "the action sent {} ago, clipped to [-1, 1]; 0 where there was none yet"
_ORIENTATIONS = {
    "down": "the gripper points straight down and does not turn: the left finger is on the side of negative y",
    "down_any_turn": "the gripper points straight down; its turn about the vertical is not controlled",
    "free": "the gripper's orientation is not controlled",
}
_COUPLING = (
    "each finger has a servo of its own, and all are sent to the same share of their way: they press with equal force, "
    "and nothing holds them at equal distances from the middle"
)


def describe(
    trained: Trained, format_name: str, networks: Mapping[str, tuple[Network, tuple[float, float]]], measured: Measured
) -> Description:
    """Describe an exported policy, by plain values.

    Args:
        trained: the policy, in its nominal world.
        format_name: of the files.
        networks: by the names of their files, with the differences that the parity test found.
        measured: in its world.
    """
    world, frozen = trained.world, trained.acts_with
    robot, seen = described(world), layouts(world)
    parts = {"policy": trained} if frozen is None else {"orchestrator": trained, "primitives": frozen}
    with WorldBatch(world, 1) as worlds:
        joints = dict(zip(robot.joints, worlds.joints[0].tolist(), strict=True))
        widest_m = worlds.robot.widest_m
        effector_m, reach, fixtures = worlds.ee_position[0].tolist(), worlds.reach, _fixtures(worlds.model)
        width_m = float(worlds.robot.openings(worlds.states[:, worlds.layout["fingers"]]).sum())
        turn = bool(worlds.robot.turning.any())
    most = _each(robot.finger_max_force, robot)
    return {
        "format_version": 2,
        "name": trained.name if frozen is None else f"{trained.name} with {frozen.name}",
        "kind": "bob" if trained.task is None else "orchestrator",
        "task": None if trained.task is None else trained.task.name,  # that an orchestrator was trained for
        "format": format_name,
        "made": {
            "tandem": __version__,
            "git_commit": git_commit(),
            "created": datetime.now(UTC).isoformat(timespec="seconds"),
            "sha256": {part: digest_of("", each.parameters) for part, each in parts.items()},  # what went in
        },
        "rate_hz": 1.0 / world.step_s,  # of observations and actions
        "networks": [_network(file, *found) for file, found in networks.items()],
        "observation": [field for entry in seen.bob.entries for field in _fields(entry, seen)],
        "observation_size": seen.bob.size,
        "positions_size": seen.positions.size,  # the first numbers of an observation, all that primitives see
        "action": _action(),
        "command": _command(1e3 * world.step_s, robot.lowest_m, widest_m),
        "frame": {  # of all positions
            "origin": "the table top, in the middle of the table's width; of the Panda 0.6 m in front of its base",
            "axes": "x away from the robot's base, y to the robot's left, z up",
            "base_position_m": robot.base_position_m,
            "base_turn_rad": robot.base_turn_rad,  # about the vertical
        },
        "tip": robot.effector.model_dump(mode="json"),  # its place in a frame of the robot's model
        "tip_orientation": _ORIENTATIONS[robot.orientation],
        "home": {"joints": joints, "effector_m": effector_m, "width_m": width_m},  # where episodes start; rad or m
        "clips": {  # what the world's controller makes of what a policy asks for
            "lowest_m": robot.lowest_m,  # least height of a set-point
            "max_turn_rad": MAX_TURN_RAD,  # most that a joint is asked to turn (or slide, m) in a step
            "width_m": (0.0, widest_m),
            "reach": _reachable(reach),  # null: joint limits are all that holds the arm back
        },
        "gripper": {  # numbers of each finger's servo: N, N/m, or N m, N m/rad
            "opening_m": robot.opening_m,
            "max_force_n": None if turn else most,  # this is the grip's force
            "max_torque_nm": most if turn else None,  # of fingers that turn
            "stiffness": _each(robot.finger_stiffness, robot),
            "damping": _each(robot.finger_damping, robot),
            "coupling": _COUPLING,
        },
        "workspace": {"lower_m": world.workspace.lower_m, "upper_m": world.workspace.upper_m},  # of goals and objects
        "objects": [  # that have goals, in the order of the observation
            {
                "shape": body.shape,
                "extent_m": body.extent_m,
                "mass_kg": body.mass_kg,
                "friction": body.friction,
                "color": body.color,
                "pad_friction": world.pad_friction,  # of the fingertips on it
            }
            for body in world.bodies
        ],
        "obstacles": [  # that start elsewhere in every episode
            {"shape": each.shape, "extent_m": each.extent_m, "mass_kg": each.mass_kg, "friction": each.friction}
            for each in world.obstacles
        ],
        "fixtures": fixtures,  # that are the same in every episode; the box of the task box is elsewhere in each
        # None: a function of the task says what counts
        "success_distance_m": trained.success_distance_m if trained.task is None or not trained.task.success else None,
        "measured": measured,
        "tolerated_late_steps": tolerated_late_steps(measured),
    }


def _fixtures(model: mujoco.MjModel) -> list[dict[str, Any]]:
    """Fixtures that do not move from episode to episode, by the upright boxes around them."""
    data, found = mujoco.MjData(model), []
    mujoco.mj_kinematics(model, data)
    for geom in range(model.ngeom):
        name = model.geom(geom).name
        if not name.startswith(FIXTURE_PREFIX) or model.body_mocapid[model.geom_bodyid[geom]] >= 0:
            continue
        turn, (middle, half) = data.geom_xmat[geom].reshape(3, 3), model.geom_aabb[geom].reshape(2, 3)
        middle, half = data.geom_xpos[geom] + turn @ middle, np.abs(turn) @ half
        lower, upper = (middle - half).round(6).tolist(), (middle + half).round(6).tolist()
        found.append({"lower_m": lower, "upper_m": upper, "name": name.removeprefix(FIXTURE_PREFIX)})
    return found


def _network(file: str, network: Network, differences: tuple[float, float]) -> dict[str, Any]:
    """Shapes are without N, the number of rows."""
    return {
        "file": file,
        "title": network.title,
        "inputs": [{"name": name, "shape": [size]} for name, size in network.inputs.items()],
        "outputs": [{"name": name, "shape": shape} for name, shape in network.outputs.items()],
        "max_abs_difference": differences[0],  # of any output from the policy's, at usual inputs
        "max_abs_difference_extreme": differences[1],
    }


def _fields(entry: Entry, seen: Layouts) -> list[dict[str, Any]]:
    """Numbers of an observation that stand one after the other, from column ``first`` on: of each object its own."""
    meaning = _MEANINGS.get(entry.name, entry.name.replace("_", " "))
    if entry.name.startswith(COMMAND_PREFIX):
        age = entry.name.removeprefix(COMMAND_PREFIX)
        meaning = _COMMAND_MEANING.format("1 step" if age == "1" else f"{age} steps")
    num = seen.num_objects if entry.of_each_object else 1
    size, start = len(entry.kind.source) // num, seen.bob[entry.name].start
    kind = Kind(entry.kind.source[:size], entry.kind.sign[:size])
    return [
        {
            "name": entry.name if number == 1 else f"{entry.name}_{number}",
            "first": start + size * (number - 1),
            "components": _COMPONENTS[kind],
            "unit": entry.unit,
            "frame": "world" if kind == VECTOR else None,
            "meaning": f"of {_which(number, num)}: {meaning}" if entry.of_each_object else meaning,
        }
        for number in range(1, num + 1)
    ]


def _which(number: int, num: int) -> str:
    return "the object" if num == 1 else f"object {number}"


def _action() -> list[dict[str, Any]]:
    """The numbers of an action, each in [-1, 1]; 1 asks for ``full``, which the arm does not reach in a step."""
    way, change = "way along {} from the tip to its set-point", "change of the gripper's width from what it is now"
    moves = [{"name": axis, "unit": "m", "full": DISPLACEMENT_M, "meaning": way.format(axis)} for axis in "xyz"]
    return [*moves, {"name": "width", "unit": "m", "full": WIDTH_CHANGE_M, "meaning": f"{change}; positive opens"}]


def _command(step_ms: float, lowest_m: float, widest_m: float) -> list[str]:
    """How an action becomes set-points, in order."""
    return [
        "clip the action to [-1, 1]; the networks have done so",
        f"set-point = tip as measured now + {DISPLACEMENT_M:g} m x (x, y, z): not from the last set-point",
        f"raise a set-point below {lowest_m:g} m to that height; move one out of reach to the nearest in reach",
        f"width = width as measured now + {WIDTH_CHANGE_M:g} m x width, clipped to 0 to {widest_m:g} m, half of it for "
        "each finger",
        f"hold both for {step_ms:g} ms, then observe again: the arm covers a part of the way only, see measured",
    ]


def _reachable(reach: Reach) -> dict[str, list[float]] | None:
    """Distances from the base's axis that set-points are clipped to, by height."""
    if not np.isfinite(reach.furthest).all():
        return None
    return {
        "axis_m": reach.axis.tolist(),
        "height_m": reach.height.tolist(),
        "nearest_m": reach.nearest.tolist(),
        "furthest_m": reach.furthest.tolist(),
    }


def _each(value: Numbers, robot: RobotConfig) -> tuple[float, ...]:
    return value if isinstance(value, tuple) else (value,) * len(robot.fingers)


# --- the README ------------------------------------------------------------------------------------------------------

_NEEDS = {
    "onnx": "`pip install numpy onnxruntime`",
    "numpy": "`pip install numpy`; `policy.py` is all the program that is needed",
    "torchscript": "`pip install numpy torch`",
}
_LOAD = {
    "onnx": 'import onnxruntime\nnetwork = onnxruntime.InferenceSession("{}")',
    "numpy": 'from policy import load\nnetwork = load("{}")',
    "torchscript": 'import torch\nnetwork = torch.jit.load("{}")',
}
_CALL = {
    "onnx": 'network.run(["action"], inputs)[0][0]',
    "numpy": 'network(*inputs.values())["action"][0]',
    "torchscript": "network(*map(torch.from_numpy, inputs.values()))[0][0].numpy()  # outputs as in the table",
}
_PROGRAM = """\
import json
import numpy as np
{load}
about = json.load(open("policy.json"))
seen = {{
{seen}
}}
rows = np.concatenate([seen[field["name"]] for field in about["observation"]])
observation = rows[None].astype(np.float32)
positions = observation[:, : about["positions_size"]]
inputs = {{{inputs}}}
action = {call}
print(action)"""
_README = """\
# {name}

Exported by Tandem {made[tandem]} on {made[created]}. All of this is also in `policy.json`, for programs.

{networks_table}

N is any number of rows from 1 on; all arrays are float32. Normalisation and clipping are inside. `action` is the \
mean, without noise, in [-1, 1]. A NaN in what a network looks at gives a NaN. No output differs from the policy that \
Tandem evaluates by more than {usual:.1e} (with extreme inputs {extreme:.1e}).

## Run it

{needs}. In this folder, with what one episode began with:

```python
{program}
```

## What it sees

{observation_size} numbers, {rate_hz:g} times a second. The frame of all positions: {frame[axes]}; its origin is \
{frame[origin]}. The tip is the point between the fingertips; {tip_orientation}.

{observation_table}

The first {positions_size} of them are called `positions`; primitives see nothing else. `previous_positions`, which \
orchestrators take, are those of one step ago; at an episode's start those of now.

## What it does

{action_table}

{rules}

## What the arm makes of it

The policy has learned with an arm that covers a part of the way in a step, and corrects itself by what it sees. **An \
arm that does at once what the action asks for moves too far.** Match the share in motion:

{response_table}

{covered} A finger {pressing}; {gripper[coupling]}.

{motion_table}

## Late observations

{late_table}

{told}Up to {tolerated_ms:.0f} ms of delay cost less than 10 points.

## Where it plays

Objects and goals are in {box} m; in {measured[motion][outside_workspace]:.1%} of steps the tip is outside. \
{things}. Episodes start with the tip at {home_m} m and the gripper open by {home_mm:.0f} mm.
"""
_TASK = "\nThe task: {}.\n"
_OBSTACLES = "\nThese start on the table, elsewhere in every episode{}:\n\n{}\n"
_FIXTURES = "\nThese stand on the table, here by the upright boxes around them; it does not see them:\n\n{}\n"


def make_readme(about: Description, start: FloatArray) -> str:
    """The text of the README.

    Args:
        about: the policy.
        start: (O,) what an episode began with.
    """
    measured, networks = about["measured"], about["networks"]
    step_ms = 1e3 / about["rate_hz"]
    observes_delay = any(field["name"] == DELAY for field in about["observation"])
    text = _README.format(
        **about,
        networks_table=table(
            ("file", "what it is", "inputs", "outputs"),
            ((f"`{one['file']}`", one["title"], _arrays(one["inputs"]), _arrays(one["outputs"])) for one in networks),
        ),
        usual=max(one["max_abs_difference"] for one in networks),
        extreme=max(one["max_abs_difference_extreme"] for one in networks),
        needs=_NEEDS[about["format"]],
        program=program(about, start),
        observation_table=table(
            ("first column", "name", "components", "unit", "meaning"),
            (
                (one["first"], one["name"], ", ".join(one["components"]), one["unit"], one["meaning"])
                for one in about["observation"]
            ),
        ),
        action_table=table(
            ("number", "1 asks for", "meaning"),
            ((one["name"], f"{one['full']:g} {one['unit']}", one["meaning"]) for one in about["action"]),
        ),
        rules="\n".join(f"{place}. {rule[0].upper()}{rule[1:]}." for place, rule in enumerate(about["command"], 1)),
        response_table=table(
            ("axis", "share covered in a step, in motion", "from rest"),
            (
                (
                    f"{'+' if one['direction'] > 0 else '-'}{one['axis']}",
                    f"{one['moving_mean']:.3f} (spread {one['moving_std']:.3f})",
                    f"{one['from_rest_mean']:.3f} (spread {one['from_rest_std']:.3f})",
                )
                for one in measured["response"]
            ),
        ),
        covered=" ".join(
            f"{'Opening' if one['direction'] > 0 else 'Closing'}, the gripper comes {1e3 * one['covered_m']:.0f} of "
            f"{1e3 * one['asked_m']:.0f} mm in its first step."
            for one in measured["width_response"]
            if one["asked_m"] > 0.0
        ),
        pressing=_pressing(about["gripper"]),
        motion_table=table(
            (f"in {measured['motion']['num_episodes']} episodes", "median", "99 %", "greatest"),
            (
                (title, *(f"{value:.2f}" for value in measured["motion"][key].values()))
                for title, key in (
                    ("tip speed, m/s", "tip_speed_m_s"),
                    ("tip acceleration, m/s2", "tip_acceleration_m_s2"),
                )
            ),
        ),
        late_table=table(
            ("positions are late by", "success at the last step (95 %)"),
            (
                (
                    f"{one['steps'] * step_ms:.0f} ms",
                    f"{one['success_last']:.1%} ({one['success_last_low']:.1%} to {one['success_last_high']:.1%})",
                )
                for one in measured["late_observations"]
            ),
        ),
        told="It is told how late they are, by `delay`. " if observes_delay else "",
        tolerated_ms=about["tolerated_late_steps"] * step_ms,
        box=", ".join(f"{axis} {bounds}" for axis, bounds in zip("xyz", _ranges(about["workspace"]), strict=True)),
        things=_things(about["objects"]),
        home_m=", ".join(f"{each:.3f}" for each in about["home"]["effector_m"]),
        home_mm=1e3 * about["home"]["width_m"],
    )
    if about["task"] is not None:
        text += _TASK.format(about["task"])
    if about["obstacles"]:
        seen = any(field["name"].startswith(OBSTACLE_PREFIX) for field in about["observation"])
        things = ((one["shape"], _size(one), f"{one['mass_kg']:g}") for one in about["obstacles"])
        text += _OBSTACLES.format(
            "" if seen else "; it does not see them", table(("obstacle", "size, mm", "mass, kg"), things)
        )
    if about["fixtures"]:
        rows = ((one["name"], *_ranges(one)) for one in about["fixtures"])
        text += _FIXTURES.format(table(("fixture", "x, m", "y, m", "z, m"), rows))
    return text


def program(about: Description, start: FloatArray) -> str:
    """A program that runs the first network of the folder once, in the folder; see ``make_readme``."""
    network, name = about["networks"][0], about["format"]
    given = {"observation": "observation", "positions": "positions", "previous_positions": "positions"}
    values = (start.astype(float).round(4) + 0.0).tolist()  # no -0.0
    seen = [f'    "{one["name"]}": {values[one["first"] :][: len(one["components"])]},' for one in about["observation"]]
    return _PROGRAM.format(
        load=_LOAD[name].format(network["file"]),
        seen="\n".join(seen),
        inputs=", ".join(f'"{one["name"]}": {given[one["name"]]}' for one in network["inputs"]),
        call=_CALL[name],
    )


def _things(objects: Sequence[Mapping[str, Any]]) -> str:
    """What each object is, in words."""
    words = []
    for number, one in enumerate(objects, 1):
        size = _size(one)
        shape = f"{'an' if one['shape'] == 'ellipsoid' else 'a'} {one['shape']}"
        words.append(f"{_which(number, len(objects))} is {shape} of {size} mm and {one['mass_kg']:g} kg")
    said = ", ".join(words)
    return said[0].upper() + said[1:]


def _size(thing: Mapping[str, Any]) -> str:
    """Of an object or an obstacle, mm."""
    return " x ".join(f"{1e3 * each:g}" for each in thing["extent_m"])


def _pressing(gripper: Mapping[str, Any]) -> str:
    if gripper["max_force_n"] is None:
        return f"turns with up to {max(gripper['max_torque_nm']):g} N m"
    return f"presses with up to {max(gripper['max_force_n']):g} N"


def _ranges(box: Mapping[str, Sequence[float]]) -> list[str]:
    return [f"{low:g} to {high:g}" for low, high in zip(box["lower_m"], box["upper_m"], strict=True)]


def _arrays(entries: Iterable[Mapping[str, Any]]) -> str:
    return ", ".join(f"`{one['name']}` ({', '.join(['N', *map(str, one['shape'])])})" for one in entries)
