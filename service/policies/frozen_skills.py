"""Frozen skills in NumPy: to act by a skill vector, without torch."""

from __future__ import annotations

import math

import numpy as np

from service.base.errors import TandemError
from service.base.types import FloatArray
from service.config.skills import Prior, SkillsConfig
from service.envs.observations import BOB, POSITIONS
from service.policies.forward import prepared, relu_layers
from service.policies.numpy_actor import NUM_MOTION_INPUTS, NumpyActor, motion_inputs
from service.policies.parameters import Parameters, PolicyError, checked, fitting

_OBJECT = POSITIONS["object"]
_GREATEST_SKILL = 1.5
"""Greatest component of a skill that an orchestrator sets, in standard deviations of the prior."""


def normalised_place(place: FloatArray) -> FloatArray:
    """(N, 3) places of the object, metres, normalised: what rewards see, the paper's prior."""
    normalisation = POSITIONS.normalisation
    state: FloatArray = (place - normalisation.offset[_OBJECT]) / normalisation.scale[_OBJECT]
    return state.astype(np.float32, copy=False)


def skill_inputs(previous: FloatArray, positions: FloatArray, skill: FloatArray) -> FloatArray:
    """(N, 17 + Z) inputs of a policy that (N, Z) skills steer; see ``motion_inputs``."""
    inputs: FloatArray = np.concatenate((motion_inputs(previous, positions), skill), axis=1)
    return inputs


def draw_skills(prior: Prior, num: int, size: int, rng: np.random.Generator) -> FloatArray:
    """(num, Z) skills of a prior: N(0, I), uniform on the unit sphere, or uniform in [-1, 1]."""
    if prior == "uniform":
        return rng.uniform(-1.0, 1.0, (num, size)).astype(np.float32)
    drawn: FloatArray = rng.standard_normal((num, size), dtype=np.float32)
    if prior == "sphere":
        drawn /= np.linalg.norm(drawn, axis=1, keepdims=True)
    return drawn


def export_skills(actor: Parameters, network: Parameters) -> dict[str, FloatArray]:
    """One dict of an actor's parameters and those of the network that its reward came from."""
    parts = {"actor": actor, "network": network}
    return {f"{part}.{name}": array for part, arrays in parts.items() for name, array in arrays.items()}


class FrozenSkills:
    """A policy that a skill vector steers, and the network that its reward came from.

    Args:
        parameters: of ``export_skills``.
        config: of the method that learned them.

    Raises:
        PolicyError: a parameter is missing, of a wrong shape or not finite.
    """

    def __init__(self, parameters: Parameters, config: SkillsConfig) -> None:
        parts: dict[str, dict[str, FloatArray]] = {"actor": {}, "network": {}}
        for name, array in parameters.items():
            part, _, rest = name.partition(".")
            if part not in parts:
                raise PolicyError(
                    f"policy parameter {name!r}: not of skills; load what a skill-discovery run published"
                )
            parts[part][rest] = array
        self.actor, self.method = NumpyActor(parts["actor"]), config.method
        self.prior, self.zero_shot = config.prior, config.zero_shot
        self.size = self.actor.num_inputs - NUM_MOTION_INPUTS
        """Z."""
        network = {f"network.{name}": array for name, array in parts["network"].items()}
        with fitting():
            self.network = prepared(np, checked(network))["network"]
            relu_layers(np, self.network, np.zeros((1, len(self.network[0][0])), np.float32))

    def draw(self, num: int, rng: np.random.Generator) -> FloatArray:
        """(num, Z) skills of the prior."""
        return draw_skills(self.prior, num, self.size, rng)

    def from_action(self, actions: FloatArray) -> FloatArray:
        """Convert (N, Z) actions in [-1, 1] of an orchestrator to (N, Z) skills.

        Of N(0, I) up to 1.5 standard deviations, as in CSF's code; on the unit sphere their direction; else they
        themselves.
        """
        if self.prior == "uniform":
            return actions
        if self.prior == "sphere":
            normalised: FloatArray = actions / np.maximum(
                np.linalg.norm(actions, axis=1, keepdims=True), np.float32(1e-6)
            )
            return normalised
        return np.float32(_GREATEST_SKILL) * actions

    def actions(self, previous: FloatArray, positions: FloatArray, skill: FloatArray) -> FloatArray:
        """(N, 4) mean actions of (N, Z) skills.

        Args:
            previous: (N, 11) positions one step ago; at an episode's start those of now.
            positions: (N, 11), metres.
            skill: (N, Z).

        Raises:
            TandemError: skills of another size.
        """
        if skill.shape[-1] != self.size:
            raise TandemError(
                f"skill: expected shape (N, {self.size}), got {skill.shape}; its size is that of training"
            )
        return self.actor(skill_inputs(previous, positions, skill))

    def towards(self, positions: FloatArray, goal: FloatArray) -> FloatArray:
        """(N, Z) skills that lead to (N, 3) goals, metres, without learning: zero-shot.

        LSD, METRA, CSF: the direction from phi(s) to phi(g), as long as skills are on average. DIAYN: the network's
        outputs at g.

        Raises:
            TandemError: the method, such as DADS, has no skill for a goal.
        """
        there = normalised_place(goal)
        if self.zero_shot == "place":
            found: FloatArray = relu_layers(np, self.network, there)
            return found
        if self.zero_shot == "none":
            raise TandemError(f"skills of {self.method} lead to no goal; learn an orchestrator")
        here = normalised_place(positions[:, _OBJECT])
        step = relu_layers(np, self.network, there) - relu_layers(np, self.network, here)
        mean_length = math.sqrt(2.0) * math.gamma((self.size + 1) / 2) / math.gamma(self.size / 2)  # of N(0, I)
        length = np.float32(1.0 if self.prior == "sphere" else mean_length)
        skills: FloatArray = length * step / np.maximum(np.linalg.norm(step, axis=1, keepdims=True), np.float32(1e-6))
        return skills


class SkillPlayer:
    """Plays N episodes from their start, each by its own skill: (N, 11) positions to actions (N, 4)."""

    def __init__(self, skills: FrozenSkills, skill: FloatArray) -> None:
        self._skills, self._skill = skills, skill
        self._previous: FloatArray | None = None

    def __call__(self, positions: FloatArray) -> FloatArray:
        """Act."""
        previous, self._previous = self._previous, positions.copy()
        return self._skills.actions(positions if previous is None else previous, positions, self._skill)


class ZeroShotPolicy:
    """Plays N episodes from their start by the skill that leads from where the object is to the goal."""

    def __init__(self, skills: FrozenSkills) -> None:
        self.skills = skills
        self.begin()

    def begin(self) -> None:
        """Forget the last step: new episodes begin."""
        self._previous: FloatArray | None = None

    def act_deterministic(self, observation: FloatArray) -> FloatArray:
        """(N, 14) Bob's input, positions and goal, to actions (N, 4)."""
        positions = observation[:, : POSITIONS.size]
        previous, self._previous = self._previous, positions.copy()
        skill = self.skills.towards(positions, observation[:, BOB["goal"]])
        return self.skills.actions(positions if previous is None else previous, positions, skill)
