"""Networks that begin from trained ones of the same or of another layout."""

import numpy as np
import pytest
import torch

from service.config.self_play import MCPConfig, MLPConfig, PolicyConfig
from service.envs.observations import PAPER, Layouts
from service.learner.transfer import BOB_INPUTS, take_over
from service.policies import networks

SMALL = PolicyConfig(
    alice=MLPConfig(hidden_sizes=(8,)),
    value=MLPConfig(hidden_sizes=(8,)),
    bob=MCPConfig(num_primitives=3, trunk_hidden_sizes=(8,), primitive_hidden_size=4, gate_hidden_sizes=(8,)),
)
WIDER = Layouts(num_commands=2)
MAKERS = {
    "alice": (networks.make_alice, ("full",)),
    "alice_value": (lambda config, seen: networks.ValueNetwork(seen.full.normalisation, config.value), ("full",)),
    "bob": (networks.make_bob, BOB_INPUTS),
    "bob_value": (
        lambda config, seen: networks.ValueNetwork(seen.bob_value.normalisation, config.value),
        ("bob_value",),
    ),
}


def outputs(network, rows):
    with torch.no_grad():
        found = network(torch.from_numpy(rows))
    return torch.cat(found, -1) if isinstance(found, tuple) else found


def rows_of(layout, entries):
    """(5, O) rows of a layout, from values by entry; others at random."""
    rows = np.random.default_rng(1).normal(size=(5, layout.size)).astype(np.float32)
    for name, values in entries.items():
        if name in layout.columns:
            rows[:, layout[name]] = values
    return rows


@pytest.mark.parametrize("name", MAKERS)
@pytest.mark.parametrize(("before", "after"), [(PAPER, PAPER), (PAPER, WIDER)])
def test_it_computes_what_the_trained_one_did(name, before, after):
    make, inputs = MAKERS[name]
    torch.manual_seed(0)
    trained, new = make(SMALL, before), make(SMALL, after)
    before_layout, after_layout = getattr(before, inputs[0]), getattr(after, inputs[0])
    said = take_over(new, networks.export_parameters(trained), before, after, inputs)
    assert said == ("taken" if before is after else "taken: new command_1, command_2")
    rows = rows_of(before_layout, {})
    wider = rows_of(after_layout, {entry: rows[:, part] for entry, part in before_layout.columns.items()})
    torch.testing.assert_close(outputs(new, wider), outputs(trained, rows))


def test_bounds_are_those_of_the_configuration():
    """A resumed run has them from there, too."""
    bounds = {"log_std_min": -1.2, "log_std_max": 0.3, "weight_floor": 0.05}
    trained = networks.make_bob(SMALL, PAPER)
    new = networks.make_bob(SMALL.model_copy(update={"bob": SMALL.bob.model_copy(update=bounds)}), PAPER)
    own = {name: tensor.clone() for name, tensor in new.named_buffers() if not tensor.dim()}
    assert sorted(each.item() for each in own.values()) == pytest.approx(sorted(bounds.values()))
    assert take_over(new, networks.export_parameters(trained), PAPER, PAPER, BOB_INPUTS) == "taken"
    assert {name: new.get_buffer(name).item() for name in own} == {name: each.item() for name, each in own.items()}
    assert all(torch.equal(tensor, new.get_parameter(name)) for name, tensor in trained.named_parameters())


def test_policies_of_two_objects():
    two, wider = (Layouts(num_commands=num, num_objects=2, alike=(0, 1)) for num in (0, 2))
    torch.manual_seed(0)
    trained, new = networks.make_bob(SMALL, two), networks.make_bob(SMALL, wider)
    parameters = networks.export_parameters(trained)
    assert take_over(new, parameters, two, wider, BOB_INPUTS) == "taken: new command_1, command_2"
    rows = rows_of(two.bob, {})
    same = rows_of(wider.bob, {entry: rows[:, part] for entry, part in two.bob.columns.items()})
    torch.testing.assert_close(outputs(new, same), outputs(trained, rows))  # the nearest is first in both
    said = take_over(networks.make_bob(SMALL, PAPER), parameters, two, PAPER, BOB_INPUTS)
    assert said == "not taken, it was trained in a world of 2 objects, and this run has 1 object"
    other = Layouts(num_objects=2)
    said = take_over(networks.make_bob(SMALL, other), parameters, two, other, BOB_INPUTS)
    assert said == "not taken, objects 1, 2 were alike where it was trained, here none are"


def test_inputs_that_are_gone_are_left_out():
    torch.manual_seed(0)
    trained, new = networks.make_bob(SMALL, WIDER), networks.make_bob(SMALL, PAPER)
    said = take_over(new, networks.export_parameters(trained), WIDER, PAPER, BOB_INPUTS)
    assert said == "taken: left out command_1, command_2"
    rows = rows_of(PAPER.bob, {})
    zero = {"command_1": 0.0, "command_2": 0.0}
    wider = rows_of(WIDER.bob, {**{name: rows[:, part] for name, part in PAPER.bob.columns.items()}, **zero})
    torch.testing.assert_close(outputs(new, rows), outputs(trained, wider))


def test_other_inputs_of_the_same_number_are_not_taken_for_the_old_ones():
    obstacle, command = Layouts(num_obstacles=1, delay=True), Layouts(num_commands=1)
    assert obstacle.bob.size == command.bob.size
    torch.manual_seed(0)
    trained, new = networks.make_bob(SMALL, obstacle), networks.make_bob(SMALL, command)
    before = networks.export_parameters(new)
    said = take_over(new, networks.export_parameters(trained), obstacle, command, BOB_INPUTS)
    assert said.startswith("not taken, its inputs are ")
    assert "command_1" in said.partition("those of the trained one")[0]
    assert "obstacle_1" in said.partition("those of the trained one")[2]
    for name, array in networks.export_parameters(new).items():
        np.testing.assert_array_equal(array, before[name])


def test_other_sizes_are_not_taken_and_said():
    torch.manual_seed(0)
    other = SMALL.model_copy(update={"bob": SMALL.bob.model_copy(update={"num_primitives": 4})})
    new = networks.make_bob(SMALL)
    before = networks.export_parameters(new)
    said = take_over(new, networks.export_parameters(networks.make_bob(other)), PAPER, PAPER, BOB_INPUTS)
    assert said.startswith("not taken, ")
    assert "[4" in said or "[16" in said
    for name, array in networks.export_parameters(new).items():
        np.testing.assert_array_equal(array, before[name])
    monolithic = networks.export_parameters(networks.make_alice(SMALL))
    assert "parameters are not in both" in take_over(new, monolithic, PAPER, PAPER, BOB_INPUTS)
