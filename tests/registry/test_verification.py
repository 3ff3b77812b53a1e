"""Parameters of which no policy can be made, found by ``tandem registry verify`` and by ``load``."""

import numpy as np
import pytest
import torch

from service.base.errors import TandemError
from service.envs.observations import layouts
from service.policies.networks import export_parameters, make_bob
from service.registry.loading import load
from service.registry.publishing import publish
from tests.cli.typed import tandem
from tests.methods import skill_sets
from tests.runs.runs import assert_one_line, tiny_config


def bob():
    with torch.random.fork_rng():
        return export_parameters(make_bob(tiny_config().policy, layouts(tiny_config().world)))


def verify(registry):
    """What ``tandem registry verify`` finds, a line each."""
    result = tandem("registry", "verify", "--registry", registry.root)
    lines = result.stderr.splitlines()
    assert result.exit_code == (1 if lines else 0), result.exception
    return lines


def test_what_was_published_is_well(registry):
    publish(registry, tiny_config(), bob(), {})
    publish(registry, skill_sets.CONFIG.model_copy(update={"name": "skills"}), skill_sets.parameters(), {})
    registry.publish("other", {"a": np.zeros(2)}, spaces={}, normalisation={}, config={"seed": 3}, metrics={})
    assert verify(registry) == []
    orchestrator = {"spaces": {"kind": "orchestrator"}, "normalisation": {}, "config": {}, "metrics": {}}
    registry.publish("pushes", {"a": np.zeros(2)}, **orchestrator)
    publish(registry, skill_sets.CONFIG.model_copy(update={"name": "skills"}), bob(), {})
    first, second = verify(registry)
    assert_one_line(first, "pushes@1: policy parameter")
    assert_one_line(second, "skills@2: policy parameter", "not of skills")


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        ("gate.output.weight", np.full((2, 16), np.nan), "'gate.output.weight' of shape (2, 16) is not finite"),
        ("gate.output.bias", None, "do not fit together (KeyError: 'gate.output.bias')"),
        ("gate.output.bias", np.zeros(3), "do not fit together (ValueError: "),
    ],
)
def test_parameters_that_cannot_be_are_named(registry, name, value, said):
    parameters = bob()
    if value is None:
        del parameters[name]
    else:
        parameters[name] = np.asarray(value, dtype=np.float32)
    publish(registry, tiny_config(), parameters, {})
    assert_one_line(verify(registry)[0], "tiny@1: policy parameter", said)
    with pytest.raises(TandemError) as error:
        load("tiny", registry.root)
    assert_one_line(error.value, said)


def test_a_configuration_that_is_none(registry):
    registry.publish("tiny", bob(), config={"policy": 3}, spaces={}, normalisation={}, metrics={})
    (found,) = verify(registry)
    assert_one_line(found, "tiny@1: ", "policy")
