"""The README of an exported folder, made for its policy."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

from service.envs.observations import DELAY
from service.export.description import ArrayEntry, Description, FieldEntry
from service.export.measurements import Distribution

_GOAL_FROM_OBJECT_M = (0.05, 0.05, 0.1)
"""In the example, whose object lies in the middle of the workspace."""
_IMPORT = {"onnx": "import onnxruntime", "numpy": "from policy import load", "torchscript": "import torch"}
_LOAD = {
    "onnx": 'network = onnxruntime.InferenceSession("{}")',
    "numpy": 'network = load("{}")',
    "torchscript": 'network = torch.jit.load("{}")',
}
_NEEDS = {
    "onnx": "`pip install numpy onnxruntime`",
    "numpy": "`pip install numpy`; `policy.py` is all the program that is needed",
    "torchscript": "`pip install numpy torch`",
}


def make_readme(about: Description) -> str:
    """The text of the README."""
    sections = (_networks, _how_to_run, _observation, _action, _arm, _late, _training, _fixtures)
    return "\n\n".join(text for section in sections for text in section(about)) + "\n"


def example(about: Description) -> str:
    """A program that runs the first network of the folder once, in the folder."""
    network = about.networks[0]
    given = {"observation": "observation", "positions": "observation[:, :{}]", "previous_positions": "positions"}
    values = {each.name: given[each.name].format(about.positions_size) for each in network.inputs}
    lines = [
        "import json",
        "import numpy as np",
        _IMPORT[about.format],
        'about = json.load(open("policy.json"))',
        _LOAD[about.format].format(network.file),
        "seen = {",
        *(f'    "{field.name}": {_example_values(about, field)},' for field in about.observation),
        "}",
        'rows = np.concatenate([seen[field["name"]] for field in about["observation"]])',
        "observation = rows[None].astype(np.float32)",
    ]
    if "previous_positions" in values:
        lines.append(
            f"positions = observation[:, :{about.positions_size}]  # at an episode's start; else of one step ago"
        )
    if about.format == "onnx":
        named = ", ".join(f'"{name}": {value}' for name, value in values.items())
        lines.append(f'action = network.run(["action"], {{{named}}})[0][0]')
    elif about.format == "numpy":
        lines.append(f'action = network({", ".join(values.values())})["action"][0]')
    else:
        tensors = ", ".join(f"torch.from_numpy({value})" for value in values.values())
        lines.append(f"action = network({tensors})[0][0].numpy()  # outputs come in the order of the table")
    return "\n".join([*lines, "print(action)"])


def _example_values(about: Description, field: FieldEntry) -> list[float]:
    """An entry of an observation: home, the object on the table, a goal in the air, no command so far."""
    corners = zip(about.workspace.lower_m, about.workspace.upper_m, strict=True)
    x, y, _ = ((low + high) / 2 for low, high in corners)
    thing, tip = (x, y, about.object.extent_m[2] / 2), about.home.effector_m
    known: dict[str, Iterable[float]] = {
        "effector": tip,
        "fingers": (about.home.width_m / 2,) * 2,
        "object": thing,
        "object_from_effector": (there - here for there, here in zip(thing, tip, strict=True)),
        "goal": (here + way for here, way in zip(thing, _GOAL_FROM_OBJECT_M, strict=True)),
    }
    values = known.get(field.name, (0.0,) * len(field.components))
    return [round(value, 4) + 0.0 for value in values]  # no -0.0


def _networks(about: Description) -> Iterator[str]:
    yield f"# {about.name}"
    yield (
        f"Exported by Tandem {about.made.tandem} on {about.made.created[:10]}. All of this is also in `policy.json`, "
        "for programs."
    )
    yield _table(
        ("file", "what it is", "inputs", "outputs"),
        ((f"`{each.file}`", each.title, _arrays(each.inputs), _arrays(each.outputs)) for each in about.networks),
    )
    usual = max(each.max_abs_difference for each in about.networks)
    extreme = max(each.max_abs_difference_extreme for each in about.networks)
    yield (
        "N is any number of rows from 1 on; all arrays are float32. Normalisation and clipping are inside. `action` is "
        "the mean, without noise, in [-1, 1]. A NaN in what a network looks at gives a NaN. No output differs from the "
        f"policy that Tandem evaluates by more than {usual:.1e} (with extreme inputs {extreme:.1e})."
    )


def _how_to_run(about: Description) -> Iterator[str]:
    yield f"## Run it\n\n{_NEEDS[about.format]}. In this folder:"
    yield f"```python\n{example(about)}\n```"


def _observation(about: Description) -> Iterator[str]:
    yield "## What it sees"
    yield (
        f"{about.observation_size} numbers, {about.rate_hz:g} times a second. The frame of all positions: "
        f"{about.frame.axes}; its origin is {about.frame.origin}. The tip is the point between the fingertips; "
        f"{about.tip_orientation}."
    )
    yield _table(
        ("columns", "name", "components", "unit", "meaning"),
        (
            (
                f"{field.first} to {field.first + len(field.components) - 1}",
                field.name,
                ", ".join(field.components),
                field.unit,
                field.meaning,
            )
            for field in about.observation
        ),
    )
    yield f"The first {about.positions_size} of them are called `positions`; primitives see nothing else."
    if any(each.name == "previous_positions" for each in about.networks[0].inputs):
        yield "`previous_positions` are those of one step ago; at an episode's start those of now."


def _action(about: Description) -> Iterator[str]:
    yield "## What it does"
    yield _table(
        ("number", "1 asks for", "meaning"),
        ((entry.name, f"{entry.full:g} {entry.unit}", entry.meaning) for entry in about.action),
    )
    yield "\n".join(f"{place}. {rule[0].upper()}{rule[1:]}." for place, rule in enumerate(about.command, start=1))


def _arm(about: Description) -> Iterator[str]:
    yield "## What the arm makes of it"
    yield (
        "The policy has learned with an arm that covers a part of the way in a step, and corrects itself by what it "
        "sees. **An arm that does at once what the action asks for moves too far.** Match the share in motion:"
    )
    yield _table(
        ("axis", "share covered in a step, in motion", "from rest"),
        (
            (
                f"{'+' if each.direction > 0 else '-'}{each.axis}",
                f"{each.moving_mean:.3f} (spread {each.moving_std:.3f})",
                f"{each.from_rest_mean:.3f} (spread {each.from_rest_std:.3f})",
            )
            for each in about.measured.response
        ),
    )
    covered = (
        f"{'Opening' if each.direction > 0 else 'Closing'}, the gripper comes {1e3 * each.covered_m:.0f} of "
        f"{1e3 * each.asked_m:.0f} mm in its first step."
        for each in about.measured.width_response
        if each.asked_m > 0.0
    )
    force_n, coupling = max(about.gripper.max_force_n), about.gripper.coupling
    coupling = coupling[0].upper() + coupling[1:]
    yield f"{' '.join(covered)} A finger presses with up to {force_n:g} N. {coupling}."
    motion = about.measured.motion
    yield _table(
        (f"in {motion.num_episodes} episodes", "median", "99 %", "greatest"),
        (
            _spread("tip speed, m/s", motion.tip_speed_m_s),
            _spread("tip acceleration, m/s2", motion.tip_acceleration_m_s2),
        ),
    )


def _late(about: Description) -> Iterator[str]:
    yield "## Late observations"
    yield _table(
        ("positions are late by", "success at the last step (95 %)"),
        (
            (
                f"{1e3 * late.steps / about.rate_hz:.0f} ms",
                f"{late.success_last:.1%} ({late.success_last_low:.1%} to {late.success_last_high:.1%})",
            )
            for late in about.measured.late_observations
        ),
    )
    if any(field.name == DELAY for field in about.observation):
        yield "It is told how late they are, by `delay`."
    if about.tolerated_late_steps:
        yield f"Up to {1e3 * about.tolerated_late_steps / about.rate_hz:.0f} ms cost less than 10 points."
    else:
        yield "The first step of delay already costs more than 10 points."


def _training(about: Description) -> Iterator[str]:
    ranges = zip("xyz", about.workspace.lower_m, about.workspace.upper_m, strict=True)
    box = ", ".join(f"{axis} {low:g} to {high:g}" for axis, low, high in ranges)
    size = " x ".join(f"{1e3 * each:g}" for each in about.object.extent_m)
    home = ", ".join(f"{each:.3f}" for each in about.home.effector_m)
    yield "## Where it plays"
    yield (
        f"Objects and goals are in {box} m; in {about.measured.motion.outside_workspace:.1%} of steps the tip is "
        f"outside. The object: {about.object.shape}, {size} mm, {about.object.mass_kg:g} kg. Episodes start with the "
        f"tip at {home} m and the gripper open by {1e3 * about.home.width_m:.0f} mm."
        + ("" if about.task is None else f" The task: {about.task}.")
    )


def _fixtures(about: Description) -> Iterator[str]:
    if about.fixtures:
        yield "These stand on the table, here by the upright boxes around them; it does not see them:"
        yield _table(
            ("fixture", "x, m", "y, m", "z, m"),
            (
                (each.name, *(f"{low:g} to {high:g}" for low, high in zip(each.lower_m, each.upper_m, strict=True)))
                for each in about.fixtures
            ),
        )


def _spread(title: str, values: Distribution) -> tuple[str, ...]:
    return title, f"{values.median:.2f}", f"{values.p99:.2f}", f"{values.max:.2f}"


def _arrays(entries: Iterable[ArrayEntry]) -> str:
    return ", ".join(f"`{each.name}` ({', '.join(['N', *map(str, each.shape)])})" for each in entries)


def _table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    return "\n".join(f"| {' | '.join(line)} |" for line in (header, ["---"] * len(header), *rows))
