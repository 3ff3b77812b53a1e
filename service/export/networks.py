"""The networks of a policy that are exported, each beside what the project itself computes there."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np

from service.base.types import FloatArray
from service.config.task_methods import find_method
from service.envs.observations import ObservationLayout, layouts
from service.policies.forward import FUNCTIONS
from service.policies.learned_policy import RESIDUAL, LearnedPolicy, action_weights, learner_inputs
from service.policies.numpy_actor import MOVED, STEP_SCALE_M, numpy_actor
from service.policies.numpy_policy import NumpyMCPPolicy, NumpyPolicy
from service.policies.parameters import Parameters
from service.registry.loading import Trained

Outputs = dict[str, FloatArray]


@dataclass(frozen=True)
class Network:
    """A network that is exported: a function of ``policies.forward`` with its parameters."""

    name: str
    """Of its file, without the ending."""
    function: str
    """Name in ``forward.FUNCTIONS``."""
    title: str
    """A few words for people."""
    parameters: Parameters
    columns: Mapping[str, slice]
    """Places of what it looks for in its observation."""
    inputs: Mapping[str, int]
    """Sizes by name: N rows of each."""
    reference: Callable[..., Outputs]
    """Its outputs as the evaluator's own policy computes them."""

    @cached_property
    def outputs(self) -> dict[str, tuple[int, ...]]:
        """Shapes by name, without N."""
        rows = (np.zeros((1, size), dtype=np.float32) for size in self.inputs.values())
        return {name: array.shape[1:] for name, array in self.reference(*rows).items()}


def network_of_bob(trained: Trained) -> Network:
    """The network of a whole Bob, composed or monolithic."""
    policy, function, title = trained.policy, "monolithic", "Bob, who has no primitives"
    assert isinstance(policy, NumpyPolicy)
    if isinstance(policy, NumpyMCPPolicy):
        function, title = "bob", f"Bob: {policy.num_primitives} primitives, composed by his gate"
    act = partial(FUNCTIONS[function], np, policy.network, policy.columns)
    inputs = {"observation": layouts(trained.config.world).bob.size}
    return Network("policy", function, title, trained.parameters, policy.columns, inputs, act)


def network_of_primitive(trained: Trained, number: int) -> Network:
    """The network of one primitive alone.

    Raises:
        TandemError: this Bob is monolithic.
    """
    policy = trained.primitives
    own = {name: array for name, array in trained.parameters.items() if name.startswith("primitives.")}
    hidden = own["primitives.output_weight"].shape[1]
    for name in ("primitives.hidden.weight", "primitives.hidden.bias"):
        own[name] = own[name][number * hidden : (number + 1) * hidden]
    for name in ("primitives.output_weight", "primitives.output_bias"):
        own[name] = own[name][number : number + 1]

    def act(positions: FloatArray) -> Outputs:
        mean, variance = (each[:, number] for each in policy.primitives(positions))
        return {"action": np.clip(mean, -1.0, 1.0), "mean": mean, "variance": variance}

    inputs = {"positions": policy.num_positions}
    return Network(f"primitive_{number}", "primitive", f"primitive {number} alone", own, {}, inputs, act)


def network_of_orchestrator(learned: Trained) -> Network:
    """The network of a policy that composes primitives, with these.

    Raises:
        TandemError: the primitives are none.
    """
    policy, actor_parameters, trained = learned.primitives, learned.parameters, learned.acts_with
    assert trained is not None
    seen = layouts(trained.config.world)
    actor = numpy_actor(actor_parameters)
    num_positions, goal = seen.positions.size, seen.bob["goal"]
    residual = RESIDUAL if actor.num_actions > policy.num_primitives else 0.0

    def act(previous_positions: FloatArray, observation: FloatArray) -> Outputs:
        player, positions = LearnedPolicy(actor_parameters, policy, seen), observation[:, :num_positions]
        player.act_deterministic(np.concatenate((previous_positions, observation[:, goal]), axis=1))
        chosen = actor(learner_inputs(previous_positions, positions, observation[:, goal], seen))
        means, variances = policy.primitives(positions)
        return {
            "action": player.act_deterministic(observation),
            "weights": action_weights(chosen[:, : policy.num_primitives]),
            "means": means,
            "variances": variances,
        }

    entries = {entry.name: entry for entry in seen.positions.entries}
    moved = [replace(entries[name], name=f"{name}_moved", offset=0.0, scale=STEP_SCALE_M) for name in MOVED]
    told = seen.gate.entries[len(entries) :]
    normalisation = ObservationLayout(*entries.values(), *moved, *told).normalisation
    shown = {
        **{name: array for name, array in trained.parameters.items() if name.startswith("primitives.")},
        **{f"actor.{name}": array for name, array in actor_parameters.items()},
        "actor.input.offset": normalisation.offset,
        "actor.input.scale": normalisation.scale,
        "actor.residual": np.array(residual, dtype=np.float32),
    }
    columns = {**policy.columns, "effector": seen.positions["effector"]}
    inputs = {"previous_positions": num_positions, "observation": seen.bob.size}
    title = f"an orchestrator of {policy.num_primitives} primitives ({find_method(str(learned.method)).title})"
    return Network("policy", "orchestrator", title, shown, columns, inputs, act)
