"""Published parameters against the networks that their own configuration describes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise

import numpy as np

from service.baselines.frozen import FrozenSkills
from service.config import MCPConfig, parse_config
from service.envs.observations import ACTION, PAPER, Layouts, layouts
from service.errors import TandemError
from service.off_policy_config import SkillsConfig
from service.policies.numpy_policy import NumpyMCPPolicy
from service.primitives.loading import ORCHESTRATOR
from service.registry.manifest import Manifest
from service.sac.inputs import NUM_MOTION_INPUTS
from service.sac.numpy_actor import numpy_actor

Shapes = dict[str, tuple[int, ...]]
_OBJECT_SIZE = 3
"""Of the object's position, which rewards of skill discovery see."""


def network_problems(manifest: Manifest, arrays: Mapping[str, np.ndarray]) -> Iterator[str]:
    """Tell, in a line each, which parameters are not of the sizes that the manifest's configuration gives.

    Where all are, a policy is made of them, which tells what else is wrong. A manifest without networks in its
    configuration describes none, and nothing is asked of it.
    """
    if manifest.spaces.get("kind") == ORCHESTRATOR:
        try:
            numpy_actor(dict(arrays))
        except TandemError as error:
            yield str(error)
        return
    if "policy" not in manifest.config:
        return
    try:
        config = parse_config(manifest.config, where=f"the manifest of {manifest.reference}", recorded=True)
    except TandemError as error:
        yield str(error)
        return
    expected = (
        mcp_shapes(config.policy.bob, layouts(config.world)) if config.skills is None else skill_shapes(config.skills)
    )
    wrong = [name for name in sorted(expected.keys() | arrays.keys()) if _shape(arrays, name) != expected.get(name)]
    for name in wrong:
        there, wanted = (_named(each) for each in (_shape(arrays, name), expected.get(name)))
        yield f"parameter {name!r} is {there}, but by the configuration of the manifest {wanted}; publish it again"
    if not wrong:
        try:
            if config.skills is None:
                NumpyMCPPolicy(arrays)
            else:
                FrozenSkills(arrays, config.skills.method)
        except TandemError as error:
            yield str(error)


def mcp_shapes(config: MCPConfig, seen: Layouts = PAPER) -> Shapes:
    """Shape of every parameter of ``networks.MCPPolicy``, by name."""
    heads, outputs = config.num_primitives * config.primitive_hidden_size, 2 * ACTION.size
    trunk = (seen.positions.size, *config.trunk_hidden_sizes)
    gate = (seen.gate.size, *config.gate_hidden_sizes)
    return {
        **_input("primitives.input", seen.positions.size),
        **_layers("primitives.trunk.{}", trunk),
        **_layers("primitives.hidden", (trunk[-1], heads)),
        "primitives.output_weight": (config.num_primitives, config.primitive_hidden_size, outputs),
        "primitives.output_bias": (config.num_primitives, outputs),
        "primitives.squash.log_std_min": (),
        "primitives.squash.log_std_max": (),
        **_input("gate.input", seen.gate.size),
        **_layers("gate.hidden.{}", gate),
        **_layers("gate.output", (gate[-1], config.num_primitives)),
        "gate.weight_floor": (),
    }


def skill_shapes(config: SkillsConfig) -> Shapes:
    """Shape of every parameter of ``frozen.export_skills``, by name."""
    skill, state = config.size, _OBJECT_SIZE
    ends = (state + skill, state) if config.method == "dads" else (state, skill)
    return {
        **_layers("actor.layers.{}", (NUM_MOTION_INPUTS + skill, *config.sac.hidden_sizes, 2 * ACTION.size), step=2),
        **_layers("network.{}", (ends[0], *config.hidden_sizes, ends[1]), step=2),
    }


def _input(name: str, size: int) -> Shapes:
    return {f"{name}.offset": (size,), f"{name}.scale": (size,)}


def _layers(name: str, sizes: Sequence[int], step: int = 1) -> Shapes:
    """Weights (outputs, inputs) and biases between every two neighbours of ``sizes``."""
    shapes: Shapes = {}
    for place, (inputs, outputs) in enumerate(pairwise(sizes)):
        layer = name.format(step * place)
        shapes |= {f"{layer}.weight": (outputs, inputs), f"{layer}.bias": (outputs,)}
    return shapes


def _shape(arrays: Mapping[str, np.ndarray], name: str) -> tuple[int, ...] | None:
    return arrays[name].shape if name in arrays else None


def _named(shape: tuple[int, ...] | None) -> str:
    return "missing" if shape is None else f"of shape {list(shape)}"
