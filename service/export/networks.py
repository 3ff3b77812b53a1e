"""The networks of a policy that are exported, each beside what the project itself computes there."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from service.downstream.compose import action_weights
from service.downstream.inputs import learner_inputs
from service.downstream.methods import find_method
from service.downstream.policy import LearnedPolicy
from service.envs.observations import ACTION, GOAL_FROM_OBJECT, Layouts, layouts
from service.policies.numpy_policy import NumpyMCPPolicy
from service.policies.parameters import Parameters
from service.primitives.loading import TrainedBob
from service.sac.inputs import STEP_SCALE_M
from service.sac.numpy_actor import numpy_actor
from service.types import FloatArray

Outputs = dict[str, FloatArray]


@dataclass(frozen=True)
class Network:
    """A network that is exported: a function of ``standalone`` with its parameters."""

    name: str
    """Of its file, without the ending."""
    function: str
    """Name in ``standalone.FUNCTIONS``."""
    title: str
    """A few words for people."""
    parameters: Parameters
    columns: Mapping[str, slice]
    """Places of what it looks for in its observation."""
    inputs: Mapping[str, int]
    """Sizes by name: N rows of each."""
    outputs: Mapping[str, tuple[int, ...]]
    """Shapes by name, without N."""
    reference: Callable[..., Outputs]
    """Its outputs as the evaluator's own policy computes them."""


def networks_of_bob(trained: TrainedBob) -> list[Network]:
    """The network of a whole Bob, composed or monolithic."""
    seen = layouts(trained.config.world)
    policy, parameters = trained.policy, trained.parameters
    if not isinstance(policy, NumpyMCPPolicy):

        def act(observation: FloatArray) -> Outputs:
            return {"action": np.clip(policy.act_deterministic(observation), -1.0, 1.0)}

        shapes = {"action": (ACTION.size,)}
        return [Network("policy", "monolithic", "Bob, who has no primitives", parameters, {}, _sees(seen), shapes, act)]

    def compose(observation: FloatArray) -> Outputs:
        means, variances = policy.primitives(observation[:, : seen.positions.size])
        action = np.clip(policy.act_deterministic(observation), -1.0, 1.0)
        return {"action": action, "weights": policy.gate(observation), "means": means, "variances": variances}

    title = f"Bob: {policy.num_primitives} primitives, composed by his gate"
    return [Network("policy", "bob", title, parameters, _columns(seen), _sees(seen), _composed_shapes(policy), compose)]


def networks_of_primitives(trained: TrainedBob) -> list[Network]:
    """A network for each primitive.

    Raises:
        TandemError: this Bob is monolithic.
    """
    policy, seen = trained.primitives, layouts(trained.config.world)
    return [_primitive(policy, trained.parameters, number, seen) for number in range(policy.num_primitives)]


def network_of_orchestrator(trained: TrainedBob, method_name: str, actor_parameters: Parameters) -> Network:
    """The network of an orchestrator, with the primitives that it composes.

    Args:
        trained: the primitives.
        method_name: that it was learned by, one that composes.
        actor_parameters: that were learned.

    Raises:
        TandemError: the primitives are none.
    """
    policy, seen, method = trained.primitives, layouts(trained.config.world), find_method(method_name)
    actor = numpy_actor(actor_parameters)
    num_positions, goal = seen.positions.size, seen.bob["goal"]

    def act(previous_positions: FloatArray, observation: FloatArray) -> Outputs:
        player, positions = LearnedPolicy(actor_parameters, method, trained), observation[:, :num_positions]
        player.act_deterministic(np.concatenate((previous_positions, observation[:, goal]), axis=1))
        chosen = actor(learner_inputs(previous_positions, positions, observation[:, goal], seen))
        means, variances = policy.primitives(positions)
        return {
            "action": player.act_deterministic(observation),
            "weights": action_weights(chosen[:, : policy.num_primitives]),
            "means": means,
            "variances": variances,
        }

    moved = ("effector", "object")
    moved_size = sum(seen.positions[name].stop - seen.positions[name].start for name in moved)
    layers = [name for name in actor_parameters if name.endswith(".weight")]
    shown = {
        **{name: array for name, array in trained.parameters.items() if name.startswith("primitives.")},
        **{
            f"actor.layers.{place}.{kind}": actor_parameters[f"layers.{2 * place}.{kind}"]  # ReLUs stand in between
            for place in range(len(layers))
            for kind in ("weight", "bias")
        },
        "actor.input.offset": _joined(seen, "offset", moved_size, 0.0),
        "actor.input.scale": _joined(seen, "scale", moved_size, STEP_SCALE_M),
        "actor.residual": np.array(method.residual, dtype=np.float32),
    }
    columns = {**_columns(seen), "effector": seen.positions["effector"]}
    inputs = {"previous_positions": num_positions, **_sees(seen)}
    title = f"an orchestrator of {policy.num_primitives} primitives ({method.title})"
    return Network("policy", "orchestrator", title, shown, columns, inputs, _composed_shapes(policy), act)


def _primitive(policy: NumpyMCPPolicy, parameters: Parameters, number: int, seen: Layouts) -> Network:
    own = {name: array for name, array in parameters.items() if name.startswith("primitives.")}
    hidden = own["primitives.output_weight"].shape[1]
    for name in ("primitives.hidden.weight", "primitives.hidden.bias"):
        own[name] = own[name][number * hidden : (number + 1) * hidden]
    for name in ("primitives.output_weight", "primitives.output_bias"):
        own[name] = own[name][number : number + 1]

    def act(positions: FloatArray) -> Outputs:
        mean, variance = (each[:, number] for each in policy.primitives(positions))
        return {"action": np.clip(mean, -1.0, 1.0), "mean": mean, "variance": variance}

    inputs, outputs = {"positions": seen.positions.size}, dict.fromkeys(("action", "mean", "variance"), (ACTION.size,))
    return Network(f"primitive_{number}", "primitive", f"primitive {number} alone", own, {}, inputs, outputs, act)


def _sees(seen: Layouts) -> dict[str, int]:
    return {"observation": seen.bob.size}


def _columns(seen: Layouts) -> dict[str, slice]:
    return {"positions": slice(0, seen.positions.size), "object": seen.bob["object"], "goal": seen.bob["goal"]}


def _composed_shapes(policy: NumpyMCPPolicy) -> dict[str, tuple[int, ...]]:
    num, size = policy.num_primitives, policy.action_size
    return {"action": (size,), "weights": (num,), "means": (num, size), "variances": (num, size)}


def _joined(seen: Layouts, which: str, moved_size: int, moved: float) -> FloatArray:
    """Offsets or scales of an orchestrator's inputs: positions, movements, goal, the way to it."""
    movements = np.full(moved_size, moved, dtype=np.float32)
    own, way = getattr(seen.bob.normalisation, which), getattr(GOAL_FROM_OBJECT.normalisation, which)
    goal = own[seen.bob["goal"]]
    return np.concatenate((own[: seen.positions.size], movements, goal, way))
