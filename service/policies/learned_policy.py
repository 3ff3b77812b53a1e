"""Policies that were learned for a task, in NumPy: what their networks see, and what they set.

Such a policy sets the weights of frozen primitives, sets the skill of frozen skills, or acts by itself. Torch and
Gymnasium are not needed to act.
"""

from __future__ import annotations

import numpy as np

from service.base.types import FloatArray
from service.envs.observations import PAPER, Layouts
from service.policies import forward
from service.policies.forward import INPUT_CLIP
from service.policies.frozen_skills import FrozenSkills
from service.policies.numpy_actor import motion_inputs, moved_columns, numpy_actor
from service.policies.numpy_policy import NumpyMCPPolicy
from service.policies.parameters import Parameters, PolicyError

RESIDUAL = 0.5
"""Size of the greatest action that a policy with a residual adds to the composition."""
Frozen = NumpyMCPPolicy | FrozenSkills | None
"""What a learned policy acts with: primitives, skills, or nothing."""


def num_inputs(seen: Layouts) -> tuple[int, int]:
    """Numbers of ``motion_inputs`` alone, and of ``learner_inputs``: 17 and 23 in the paper's worlds."""
    motion = seen.positions.size + len(moved_columns(seen.positions))
    return motion, motion + seen.gate.size - seen.positions.size


def learner_inputs(previous: FloatArray, positions: FloatArray, goal: FloatArray, seen: Layouts = PAPER) -> FloatArray:
    """(N, I) inputs of every downstream learner: those of ``motion_inputs``, the goals, and the ways to them.

    Args:
        previous: (N, P) positions one step ago; at an episode's start those of now.
        positions: (N, P), metres.
        goal: (N, 3 K), metres.
        seen: layouts of the world.
    """
    columns, usual = seen.bob["goal"], seen.bob.normalisation
    place = (goal - usual.offset[columns]) / usual.scale[columns]
    relative = (goal - positions[:, seen.positions["object"]]) / seen.way.normalisation.scale
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
    mean, _ = primitives.composed(positions, action_weights(actions[..., : primitives.num_primitives]))
    if residual:
        mean += np.float32(residual) * np.clip(actions[..., primitives.num_primitives :], -1.0, 1.0)
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
        hold_steps: env steps that an action of the actor lasts; more than one only where it was published so.
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
