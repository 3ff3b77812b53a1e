"""What a trial has learned, as a policy in NumPy: evaluated, recorded, saved to a file and loaded without torch."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from service.downstream.inputs import learner_inputs
from service.downstream.methods import Method, Trained, find_method, provenance
from service.envs.observations import layouts
from service.errors import TandemError
from service.io.files import os_errors, write_atomic
from service.io.tensors import decode, encode, read_metadata
from service.parsing import parse_json
from service.policies.parameters import Parameters, PolicyError
from service.regular_files import read_regular
from service.sac.numpy_actor import numpy_actor
from service.types import FloatArray

_KEY = "downstream_policy"
MAX_BYTES = 1024**3
"""Of a policy's file; usual are some hundred thousand."""


class LearnedPolicy:
    """An actor that a trial has learned: Bob's input to actions, without noise.

    It keeps the positions of the step before, so it plays N episodes from their start; others need ``begin`` first.

    Args:
        parameters: of the actor, as exported.
        method: says how its actions become the robot's.
        trained: the primitives or skills, where the method takes any.
        hold_steps: env steps that an action of the actor lasts.
    """

    def __init__(self, parameters: Parameters, method: Method, trained: Trained, hold_steps: int = 1) -> None:
        self.parameters = parameters
        self._actor, self._method, self._trained = numpy_actor(parameters), method, trained
        self._hold_steps = hold_steps
        self._seen = layouts(trained.config.world)
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
        if self._held is None or self._num_steps % self._hold_steps == 0:
            goal = observation[:, self._seen.bob["goal"]]
            self._held = self._actor(learner_inputs(previous, positions, goal, self._seen))
        self._num_steps, self._previous = self._num_steps + 1, positions.copy()
        return self._method.decode(self._trained, previous, positions, self._held)


def save_policy(path: Path, parameters: Parameters, method: str, trained: Trained, hold_steps: int = 1) -> None:
    """Write an actor's parameters, its method, and which primitives or skills it acts with.

    Raises:
        TandemError: the file cannot be written.
    """
    about = {"method": method, "primitives": provenance(trained, method)["primitives"], "hold_steps": hold_steps}
    with os_errors("write", path):
        write_atomic(path, encode(parameters, {_KEY: json.dumps(about)}))


def load_policy(path: Path | str, trained: Trained) -> LearnedPolicy:
    """Load what ``save_policy`` wrote.

    Args:
        path: ``policy.safetensors`` of a training.
        trained: the primitives or skills that it was trained with; a method that takes none takes any.

    Raises:
        TandemError: no such file, damaged, or of other primitives.
    """
    method, parameters, hold_steps = read_policy(Path(path), trained)
    return LearnedPolicy(parameters, find_method(method), trained, hold_steps)


def read_policy(path: Path, trained: Trained) -> tuple[str, Parameters, int]:
    """Method, parameters and env steps that an action lasts; see ``load_policy``."""
    with os_errors("read", path):
        data = read_regular(path, MAX_BYTES, follow=True)
    try:
        about: dict[str, Any] = dict(parse_json(read_metadata(data)[_KEY], path))
        parameters = decode(data)
    except (KeyError, ValueError) as error:
        raise TandemError(f"{path} is no policy of a downstream training ({error}); take policy.safetensors") from None
    find_method(about["method"])
    wanted, found = about["primitives"], provenance(trained, about["method"])["primitives"]
    if wanted is not None and wanted["digest"] != found["digest"]:
        raise TandemError(f"{path} acts with {wanted['name']}, not {found['name']}; load that")
    return about["method"], parameters, about.get("hold_steps", 1)
