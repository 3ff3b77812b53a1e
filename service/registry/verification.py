"""Published parameters against the networks that their own configuration describes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from service.base.errors import TandemError
from service.config import Config
from service.config.self_play import SelfPlayConfig
from service.config.skills import SkillDiscoveryConfig
from service.envs.observations import ACTION, POSITIONS, layouts
from service.policies.frozen_skills import FrozenSkills
from service.policies.inputs import NUM_MOTION_INPUTS
from service.policies.numpy_actor import numpy_actor
from service.policies.numpy_policy import NumpyMCPPolicy
from service.policies.parameters import Shapes, bob_shapes, layer_shapes, misfits
from service.registry.loading import ORCHESTRATOR
from service.registry.manifest import Manifest, acting_config

_OBJECT_SIZE = POSITIONS["object"].stop - POSITIONS["object"].start
"""Of the object's position, which rewards of skill discovery see."""


def network_problems(manifest: Manifest, arrays: Mapping[str, np.ndarray]) -> Iterator[str]:
    """Tell, in a line each, which parameters are not of the sizes that the manifest's configuration gives.

    Where all are, a policy is made of them, which tells what else is wrong. A manifest without networks in its
    configuration describes none, and nothing is asked of it.
    """
    try:
        if manifest.spaces.get("kind") == ORCHESTRATOR:
            numpy_actor(dict(arrays))
        elif manifest.config.keys() & {"policy", "skills"}:
            config = acting_config(manifest.config, where=f"the manifest of {manifest.reference}")
            yield from _problems(config, arrays)
    except TandemError as error:
        yield str(error)


def expected_shapes(config: Config) -> Shapes:
    """Shape of every parameter that a run publishes, by name: of Bob, or of skills (``frozen.export_skills``)."""
    if isinstance(config, SelfPlayConfig):
        bob, seen = config.policy.bob, layouts(config.world)
        heads = bob.num_primitives, bob.primitive_hidden_size
        return bob_shapes(seen.positions.size, bob.trunk_hidden_sizes, heads, bob.gate_hidden_sizes)
    assert isinstance(config, SkillDiscoveryConfig)
    skills = config.skills
    if skills.method == "dads":
        network = _OBJECT_SIZE + skills.size, *skills.hidden_sizes, _OBJECT_SIZE
    else:
        network = _OBJECT_SIZE, *skills.hidden_sizes, skills.size
    actor = NUM_MOTION_INPUTS + skills.size, *skills.sac.hidden_sizes, 2 * ACTION.size
    return layer_shapes("actor.layers.{}", actor, 2) | layer_shapes("network.{}", network, 2)


def _problems(config: Config, arrays: Mapping[str, np.ndarray]) -> Iterator[str]:
    found = list(misfits(arrays, expected_shapes(config)))
    for misfit in found:
        yield f"{misfit}, by the configuration of the manifest; publish it again"
    if found:
        return
    if isinstance(config, SkillDiscoveryConfig):
        FrozenSkills(arrays, config.skills.method)
    else:
        NumpyMCPPolicy(arrays)
