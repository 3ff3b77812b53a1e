"""Parameters that are not what their manifest says, found by name; and files that hash well but hold no parameters."""

import io
import json
import pickle

import numpy as np
import pytest
import torch
from typer.testing import CliRunner

from service.base import tensors
from service.base.errors import TandemError
from service.cli.main import app
from service.config import WorldConfig
from service.config.self_play import MCPConfig, PolicyConfig, SelfPlayConfig
from service.config.skills import SkillDiscoveryConfig, SkillsConfig, SkillsSACConfig
from service.envs.observations import layouts
from service.learner.sac_networks import GaussianActor
from service.methods.skill_rewards import METHODS, make_reward
from service.policies.frozen_skills import export_skills
from service.policies.networks import export_parameters, make_bob
from service.policies.numpy_actor import NUM_MOTION_INPUTS
from service.registry.blobs import BlobStore
from service.registry.loading import load
from service.registry.manifest import Manifest
from service.registry.publishing import publish
from service.registry.registry import Registry
from service.registry.verification import expected_shapes
from tests.runs.runs import assert_one_line, tiny_config

SKILLS = SkillsConfig(size=5, hidden_sizes=(6, 7), sac=SkillsSACConfig(hidden_sizes=(8, 9)))


def shapes(parameters):
    return {name: array.shape for name, array in parameters.items()}


def bob(config):
    with torch.random.fork_rng():
        return export_parameters(make_bob(config.policy, layouts(config.world)))


def skills(config):
    actor = GaussianActor(NUM_MOTION_INPUTS + config.size, 4, config.sac.hidden_sizes)
    return export_skills(export_parameters(actor), make_reward(config, 3, seed=0).exported())


def test_shapes_are_those_of_the_networks():
    bobs = MCPConfig(num_primitives=3, trunk_hidden_sizes=(6, 7), primitive_hidden_size=5, gate_hidden_sizes=(8, 9))
    config = SelfPlayConfig(policy=PolicyConfig(bob=bobs), world=WorldConfig(observed={"num_commands": 2}))
    assert expected_shapes(config) == shapes(bob(config))


@pytest.mark.parametrize("method", METHODS)
def test_shapes_are_those_of_skills(method):
    config = SKILLS.model_copy(update={"method": method})
    assert expected_shapes(SkillDiscoveryConfig(skills=config)) == shapes(skills(config))


@pytest.fixture
def registry(tmp_path):
    return Registry(tmp_path / "registry")


def verify(registry):
    """What ``tandem registry verify`` finds, a line each."""
    result = CliRunner().invoke(app, ["registry", "verify", "--registry", str(registry.root)])
    lines = result.stderr.splitlines()
    assert result.exit_code == (1 if lines else 0), result.exception
    return lines


def test_what_was_published_is_well(registry):
    publish(registry, tiny_config(), bob(tiny_config()), {})
    config = SkillDiscoveryConfig(name="skills", skills=SKILLS)
    publish(registry, config, skills(SKILLS), {})
    assert verify(registry) == []


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"gate.output.weight": np.nan}, ["parameter 'gate.output.weight' has 32 of 32 numbers that are not finite"]),
        ({"gate.output.bias": np.inf}, ["parameter 'gate.output.bias' has 2 of 2 numbers that are not finite"]),
        (
            {"gate.output.bias": None},
            ["parameter 'gate.output.bias' is missing, expected shape (2,), by", "; publish it again"],
        ),
        (
            {"gate.output.bias": np.zeros(3)},
            ["'gate.output.bias': expected shape (2,), got (3,), by", "; publish it again"],
        ),
        (
            {"gate.outlet": np.zeros(3)},
            ["parameter 'gate.outlet': expected none of that name, got (3,)", "; publish it"],
        ),
    ],
)
def test_parameters_that_cannot_be_are_named(registry, change, said):
    parameters = bob(tiny_config())
    for name, value in change.items():
        if value is None:
            del parameters[name]
        elif np.ndim(value) or name not in parameters or np.isfinite(value):
            parameters[name] = np.asarray(value, dtype=np.float32)
        else:
            parameters[name] = np.full_like(parameters[name], value)
    publish(registry, tiny_config(), parameters, {})
    assert_one_line(verify(registry)[0], "tiny@1: ", *said)
    with pytest.raises(TandemError) as error:
        load("tiny", registry.root)
    assert_one_line(error.value, next(iter(change)))


def test_sizes_of_another_configuration_are_named(registry):
    other = tiny_config().model_copy(update={"policy": PolicyConfig()})
    publish(registry, other, bob(tiny_config()), {})
    found = verify(registry)
    assert len(found) > 5
    said = "tiny@1: policy parameter 'gate.output.weight': expected shape (4, 256), got (2, 16), by the configuration"
    assert [line for line in found if line.startswith(said)]


def test_skills_of_another_size_are_named(registry):
    publish(registry, SkillDiscoveryConfig(name="skills", skills=SkillsConfig(size=4)), skills(SKILLS), {})
    assert_one_line(verify(registry)[0], "skills@1: policy parameter 'actor.layers.0.weight'", "(256, 21), got (8, 22)")


# --- files whose digests are right ------------------------------------------------------------------------------------


def forge(registry, data, **changes):
    """Put other bytes in the place of a version's parameters, with all digests as they have to be."""
    publish(registry, tiny_config(), bob(tiny_config()), {})
    fields = {"blob_sha256": BlobStore(registry.root / "blobs").put(data), "blob_bytes": len(data), **changes}
    tree = registry.manifest("tiny").model_dump(mode="json") | fields
    (registry.root / "models" / "tiny" / "versions" / "1").write_bytes(Manifest.model_validate(tree).to_bytes())


def an_npz():
    data = io.BytesIO()
    np.savez(data, **bob(tiny_config()))
    return data.getvalue()


@pytest.mark.parametrize(
    "data",
    [
        pickle.dumps({"gate.output.bias": [1.0, 2.0]}),
        an_npz(),
        b"",
        bytes(100),
        (10**6).to_bytes(8, "little") + b"[" * 10**6,
        (2**60).to_bytes(8, "little") + b"{}",
        tensors.encode({"gate.output.bias": np.zeros(2)})[:-1],
    ],
    ids=["pickle", "npz", "empty", "zeros", "deep header", "endless header", "cut short"],
)
@pytest.mark.parametrize("command", ["verify", "evaluate", "export"])
def test_a_blob_of_something_else(registry, tmp_path, data, command):
    forge(registry, data)
    arguments = {
        "verify": ["registry", "verify"],
        "evaluate": ["evaluate", "tiny"],
        "export": ["registry", "export", "tiny", str(tmp_path / "out")],
    }[command]
    result = CliRunner().invoke(app, [*arguments, "--registry", str(registry.root)])
    assert result.exit_code == (1 if command == "verify" else 2), result.exception
    assert_one_line(result.stderr, "parameters of tiny@1, is not a whole safetensors file")
    assert not (tmp_path / "out").exists()


def test_a_manifest_that_describes_other_parameters(registry):
    parameters = bob(tiny_config())
    described = tensors.describe(parameters) | {"gate.output.bias": {"shape": [10**30], "dtype": "float32"}}
    forge(registry, tensors.encode(parameters), tensors=described)
    (found,) = verify(registry)
    assert_one_line(found, "parameter 'gate.output.bias' is float32 [2], but the manifest of tiny@1 says float32 [1000")
    with pytest.raises(TandemError, match=r"gate\.output\.bias"):
        load("tiny", registry.root)


@pytest.mark.parametrize(
    "config", [{"policy": 3}, {"policy": {"bob": {"num_primitives": 10**20}}}, {"policy": [[]] * 9}]
)
def test_a_configuration_that_is_none(registry, config):
    forge(registry, tensors.encode(bob(tiny_config())), config=config)
    for found in verify(registry) or [""]:
        assert_one_line(found, "tiny@1: ")


def test_a_blob_that_is_longer_than_the_manifest_says_is_not_read(registry):
    publish(registry, tiny_config(), bob(tiny_config()), {})
    digest = registry.manifest("tiny").blob_sha256
    with BlobStore(registry.root / "blobs").path(digest).open("ab") as file:
        file.truncate(1 << 36)
    (found,) = verify(registry)
    assert_one_line(found, digest, "is damaged: it is longer than ")
    assert json.loads(registry.manifest("tiny").to_bytes())["blob_bytes"] < 100_000
    publish(registry, tiny_config(), bob(tiny_config()) | {"gate.output.bias": np.ones(2, np.float32)}, {})
