"""Policies that were learned for a task, in NumPy: what their networks see, what they set, and their file.

Such a policy sets the weights of frozen primitives, sets the skill of frozen skills, or acts by itself. Torch and
Gymnasium are not needed to act.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from service.baselines.frozen import FrozenSkills
from service.envs.observations import GOAL_FROM_OBJECT, PAPER, POSITIONS, Layouts
from service.errors import TandemError
from service.io.files import os_errors, write_atomic
from service.io.tensors import decode, encode, read_metadata
from service.parsing import parse_json
from service.policies import forward
from service.policies.forward import INPUT_CLIP
from service.policies.numpy_policy import NumpyMCPPolicy
from service.policies.parameters import Parameters, PolicyError
from service.regular_files import read_regular
from service.sac.inputs import NUM_MOTION_INPUTS, motion_inputs
from service.sac.numpy_actor import numpy_actor
from service.types import FloatArray

POLICY_FILE = "policy.safetensors"
MAX_BYTES = 1024**3
"""Of a policy's file; usual are some hundred thousand."""
RESIDUAL = 0.5
"""Size of the greatest action that a policy with a residual adds to the composition."""
_KEY = "downstream_policy"
_GOAL = PAPER.bob["goal"]
_GOAL_OFFSET, _GOAL_SCALE = PAPER.bob.normalisation.offset[_GOAL], PAPER.bob.normalisation.scale[_GOAL]
Frozen = NumpyMCPPolicy | FrozenSkills | None
"""What a learned policy acts with: primitives, skills, or nothing."""


def num_inputs(seen: Layouts) -> tuple[int, int]:
    """Numbers of ``motion_inputs`` alone, and of ``learner_inputs``: 17 and 23 in the paper's worlds."""
    motion = NUM_MOTION_INPUTS + seen.positions.size - POSITIONS.size
    return motion, motion + seen.bob.size - seen.positions.size + GOAL_FROM_OBJECT.size


def learner_inputs(previous: FloatArray, positions: FloatArray, goal: FloatArray, seen: Layouts = PAPER) -> FloatArray:
    """(N, I) inputs of every downstream learner: those of ``motion_inputs``, the goal, and the way from the object.

    Args:
        previous: (N, P) positions one step ago; at an episode's start those of now.
        positions: (N, P), metres.
        goal: (N, 3), metres.
        seen: layouts of the world.
    """
    place = (goal - _GOAL_OFFSET) / _GOAL_SCALE
    relative = (goal - positions[:, POSITIONS["object"]]) / GOAL_FROM_OBJECT.normalisation.scale
    told = np.clip(np.concatenate((place, relative), axis=1), -INPUT_CLIP, INPUT_CLIP)
    motion = motion_inputs(previous, positions, seen.positions)
    inputs: FloatArray = np.concatenate((motion, told), axis=1, dtype=np.float32)
    return inputs


def action_weights(actions: FloatArray) -> FloatArray:
    """Weights of (..., K) actions: 0.01 at -1, 1 at 1; see ``forward.action_weights``."""
    weights: FloatArray = forward.action_weights(np, np.clip(np.asarray(actions, dtype=np.float32), -1.0, 1.0))
    return weights


def compose_actions(
    primitives: NumpyMCPPolicy, positions: FloatArray, actions: FloatArray, residual: float
) -> FloatArray:
    """(..., 4) actions of the robot, not clipped.

    Args:
        primitives: K of them.
        positions: (..., P), metres.
        actions: (..., K) of a learner; with a residual (..., K + 4).
        residual: size of the greatest action that is added (Silver et al. 2018; Johannink et al. 2019).
    """
    mean, _ = primitives.compose(positions, action_weights(actions[..., : primitives.num_primitives]))
    if residual:
        mean += np.float32(residual) * actions[..., primitives.num_primitives :]
    return mean


def robot_actions(acts_with: Frozen, previous: FloatArray, positions: FloatArray, chosen: FloatArray) -> FloatArray:
    """(N, 4) actions of the robot.

    Args:
        acts_with: what the policy acts with.
        previous: (N, P) positions one step ago.
        positions: (N, P) those of now, metres.
        chosen: (N, A) that the policy sets: weights of primitives, and maybe a residual; a skill; or the action itself.
    """
    if isinstance(acts_with, NumpyMCPPolicy):
        residual = RESIDUAL if chosen.shape[1] > acts_with.num_primitives else 0.0
        return np.clip(compose_actions(acts_with, positions, chosen, residual), -1.0, 1.0)
    if isinstance(acts_with, FrozenSkills):
        return acts_with.actions(previous, positions, acts_with.from_action(chosen))
    return chosen


class LearnedPolicy:
    """An actor that was learned for a task: Bob's input to actions, without noise.

    It keeps the positions of the step before, so it plays N episodes from their start; others need ``begin`` first.

    Args:
        parameters: of the actor, as exported.
        acts_with: primitives or skills; None: the actor acts by itself.
        seen: layouts of the world that it was learned in.
        hold_steps: env steps that an action of the actor lasts.
    """

    def __init__(self, parameters: Parameters, acts_with: Frozen, seen: Layouts, hold_steps: int = 1) -> None:
        self._actor, self._acts_with = numpy_actor(parameters), acts_with
        self._seen, self.hold_steps = seen, hold_steps
        self.begin()

    def begin(self) -> None:
        """Forget the last step: new episodes begin."""
        self._previous: FloatArray | None = None
        self._held: FloatArray | None = None
        self._num_steps = 0

    def act_deterministic(self, observation: FloatArray) -> FloatArray:
        """(N, O) Bob's input, positions and goal, to actions (N, 4).

        Raises:
            PolicyError: another shape, or another N than in the step before.
        """
        if observation.ndim != 2 or observation.shape[1] != self._seen.bob.size:
            raise PolicyError(f"observation: expected shape (N, {self._seen.bob.size}), got {observation.shape}")
        if self._previous is not None and len(self._previous) != len(observation):
            raise PolicyError(
                f"observation: {len(observation)} rows, and {len(self._previous)} in the step before: call begin() "
                "before new episodes"
            )
        positions = observation[:, : self._seen.positions.size]
        previous = positions if self._previous is None else self._previous
        if self._held is None or self._num_steps % self.hold_steps == 0:
            goal = observation[:, self._seen.bob["goal"]]
            self._held = self._actor(learner_inputs(previous, positions, goal, self._seen))
        self._num_steps, self._previous = self._num_steps + 1, positions.copy()
        return robot_actions(self._acts_with, previous, positions, self._held)


class SavedPolicy(NamedTuple):
    """Content of a policy's file."""

    parameters: Parameters
    primitives: dict[str, Any] | None
    """Name and digest of what it acts with; None: it acts by itself."""
    hold_steps: int


def save_policy(
    path: Path, parameters: Parameters, method: str, primitives: dict[str, Any] | None, hold_steps: int = 1
) -> None:
    """Write an actor's parameters, its method, and which primitives or skills it acts with.

    Raises:
        TandemError: the file cannot be written.
    """
    about = {"method": method, "primitives": primitives, "hold_steps": hold_steps}
    with os_errors("write", path):
        write_atomic(path, encode(parameters, {_KEY: json.dumps(about)}))


def read_policy(path: Path) -> SavedPolicy:
    """Read what ``save_policy`` wrote.

    Raises:
        TandemError: no such file, or damaged.
    """
    with os_errors("read", path):
        data = read_regular(path, MAX_BYTES, follow=True)
    try:
        about: dict[str, Any] = dict(parse_json(read_metadata(data)[_KEY], path))
        return SavedPolicy(decode(data), about["primitives"], about.get("hold_steps", 1))
    except (KeyError, TypeError, ValueError) as error:
        raise TandemError(f"{path} is no policy of a downstream training ({error}); take {POLICY_FILE}") from None
