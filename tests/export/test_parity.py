"""What is written computes what the evaluator's policy does, in every format."""

from dataclasses import replace

import numpy as np
import pytest

from service.base.errors import ParityError
from service.envs.observations import layouts
from service.export import exporting
from service.export.exporting import check_parity, make_inputs
from service.export.formats import find_format
from service.export.networks import network_of_bob, network_of_orchestrator, network_of_primitive
from service.policies.learned_policy import LearnedPolicy
from service.policies.numpy_policy import numpy_bob
from service.registry.loading import Trained
from tests.export.policies import CONFIG, MONOLITHIC, SEEN, TWO_CUBES, actor_of, parameters_of


def bob_of(config):
    parameters = parameters_of(config)
    return Trained("made", "primitives", config, numpy_bob(parameters), parameters)


def learned(bob, method):
    seen = layouts(bob.config.world)
    actor = actor_of(method, seen)
    policy = LearnedPolicy(actor, bob.primitives, seen)
    return Trained("made", "orchestrator", bob.config, policy, actor, task="push", method=method, acts_with=bob)


def networks():
    bob, alone, of_two = bob_of(CONFIG), bob_of(MONOLITHIC), bob_of(TWO_CUBES)
    return {
        "bob": network_of_bob(bob),
        "primitive": network_of_primitive(bob, 1),
        "orchestrator": network_of_orchestrator(learned(bob, "ours-residual-her")),
        "orchestrator of weights alone": network_of_orchestrator(learned(bob, "ours")),
        "monolithic": network_of_bob(alone),
        "bob of two cubes": network_of_bob(of_two),
        "orchestrator of two cubes": network_of_orchestrator(learned(of_two, "ours-residual-her")),
    }


def inputs_of(seen):
    return make_inputs(0.1 * np.random.default_rng(2).standard_normal((5, 40, seen.bob.size)), seen)


@pytest.fixture(scope="module")
def inputs():
    return inputs_of(SEEN)


def written(network, format_name, folder):
    chosen = find_format(format_name)
    path = folder / f"{network.name}{chosen.ending}"
    chosen.write(network, path)
    return chosen.read(network, path)


@pytest.mark.parametrize(
    ("format_name", "name"),
    [
        *((each, name) for each in ("numpy", "torchscript") for name in networks()),
        ("onnx", "orchestrator of two cubes"),  # has every operation of the others; torch takes seconds for each
    ],
)
def test_parity(format_name, name, tmp_path):
    network = networks()[name]
    inputs = inputs_of(layouts((TWO_CUBES if "two cubes" in name else CONFIG).world))
    found = check_parity(network, written(network, format_name, tmp_path), *inputs)
    assert 0.0 <= found[0] <= exporting.TOLERANCE == 1e-5
    assert found[1] <= exporting.EXTREME_TOLERANCE == 1e-4
    assert next(iter(network.outputs)) == "action"


def test_actions_are_clipped_and_inputs_reach_beyond_where_networks_clip(inputs):
    bob, extreme = networks()["bob"], inputs[1]
    unclipped = bob.reference(extreme["observation"])
    assert np.nanmax(np.abs(unclipped["means"])) > 1.0
    assert np.nanmax(np.abs(unclipped["action"])) == 1.0
    normalised = (extreme["observation"] - SEEN.bob.normalisation.offset) / SEEN.bob.normalisation.scale
    assert (np.nanmax(np.abs(normalised), axis=0) > 5.0).all()
    assert np.isnan(extreme["observation"]).any(axis=0).all()


def test_what_differs_is_found(inputs, tmp_path):
    network = networks()["orchestrator"]
    run = written(network, "numpy", tmp_path)

    def changed(name, change):
        return lambda *rows: {**run(*rows), name: change(run(*rows)[name])}

    for name, change, said in (
        ("action", lambda values: values + 2e-5, "its action differs from the policy's by 2e-05, which is more than"),
        ("weights", lambda values: np.where(np.isnan(values), 0.0, values), "its weights is NaN where the policy's"),
        ("means", lambda values: values[:, 0], "its means has shape"),
    ):
        with pytest.raises(ParityError, match=said):
            check_parity(network, changed(name, change), *inputs)
    with pytest.raises(ParityError, match="its action differs"):  # one row alone is tried, too
        check_parity(network, changed("action", lambda values: values + (len(values) == 1)), *inputs)


def test_orchestrators_exported_before_0_3_load(inputs, tmp_path):
    """Their layers have the numbers 0, 1, 2: those of the ReLUs in between were left out."""
    network = networks()["orchestrator"]
    numbers = {f"actor.layers.{2 * place}.": f"actor.layers.{place}." for place in (1, 2)}
    parameters = {
        next((new + name.removeprefix(old) for old, new in numbers.items() if name.startswith(old)), name): array
        for name, array in network.parameters.items()
    }
    assert parameters.keys() - network.parameters.keys() == {"actor.layers.1.weight", "actor.layers.1.bias"}
    check_parity(network, written(replace(network, parameters=parameters), "numpy", tmp_path), *inputs)


def test_arrays_of_other_sizes(tmp_path):
    run = written(networks()["orchestrator"], "numpy", tmp_path)
    observation = np.zeros((3, SEEN.bob.size))
    with pytest.raises(ValueError, match=r"expected arrays of \(N, 19\), \(N, 22\), got \(3, 22\), \(3, 22\)"):
        run(observation, observation)
    with pytest.raises(ValueError, match=r"expected arrays of"):
        run(observation[:2, : SEEN.positions.size], observation)
    assert run(observation[:, : SEEN.positions.size], observation)["action"].dtype == np.float32
