"""Finding a Bob: in a registry, or in a run directory."""

import json
from pathlib import Path

import numpy as np
import pytest

from service.envs.observations import BOB, FULL
from service.errors import TandemError
from service.io import checkpoints
from service.io.run_directory import RunDirectory
from service.policies.numpy_policy import NumpyGaussianPolicy, NumpyMCPPolicy
from service.primitives.bundled import BUNDLED
from service.primitives.loading import load_bob, load_players, read_parameters
from service.registry.registry import Registry
from tests.runtime.runs import assert_one_line, play, tiny_config


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """(directory, learner) of a short run."""
    path = tmp_path_factory.mktemp("primitives") / "run"
    run, _ = play(path, tiny_config(total_env_steps=400, checkpoint_interval=1))
    return path, run.learner


@pytest.fixture
def registry(run, tmp_path):
    """A registry with the run's Bob as version 1, and nobody of use as version 2."""
    registry = Registry(tmp_path / "registry")
    config = tiny_config().model_dump(mode="json")
    common = {"spaces": {}, "normalisation": {}, "config": config, "metrics": {}}
    registry.publish("tiny", run[1].weights().bob, **common)
    registry.publish("tiny", run[1].weights().alice, **common)
    registry.set_alias("tiny", "champion", 1)
    return registry.root


def observations(size):
    return 0.1 * np.random.default_rng(0).standard_normal((7, size)).astype(np.float32)


def test_the_newest_bob_of_a_run_directory(run, tmp_path):
    path, learner = run
    bob = load_bob(str(path), tmp_path)
    assert bob.label == str(path)
    assert bob.manifest is None
    assert bob.config == tiny_config(total_env_steps=400, checkpoint_interval=1)
    rows = observations(BOB.size)
    expected = NumpyMCPPolicy(learner.weights().bob).act_deterministic(rows)
    assert np.array_equal(bob.policy.act_deterministic(rows), expected)


def test_a_manifest_of_version_0_1_0(run, tmp_path):
    """It came with that package; what it calls by an old name is read under the new one."""
    written = json.loads(Path(__file__).with_name("manifest_0_1_0.json").read_text())
    assert written["config"]["learner"]["bob_average_decay"] == 0.97
    assert written["config"]["learner"]["alice_interval"] == 1
    assert written["config"]["game"]["alice_proximity_reward"] == 0.0
    kept = {key: written[key] for key in ("spaces", "normalisation", "config", "metrics")}
    Registry(tmp_path).publish("old", run[1].weights().bob, **kept)
    bob = load_bob("old@1", tmp_path)
    assert bob.config.learner.bob_ema_decay == 0.97
    assert bob.config.game.bob_margin_m == 0.0  # a key that is younger has its default
    assert bob.manifest.config == written["config"]


def test_a_manifest_with_a_removed_key_that_mattered(run, tmp_path):
    config = tiny_config().model_dump(mode="json")
    config["game"]["alice_outside_reward"] = -3.0
    common = {"spaces": {}, "normalisation": {}, "config": config, "metrics": {}}
    Registry(tmp_path).publish("old", run[1].weights().bob, **common)
    with pytest.raises(TandemError) as error:
        load_bob("old@1", tmp_path)
    assert_one_line(error.value, "the manifest of old@1", "game.alice_outside_reward = -3.0", "tandem 0.1.0")


@pytest.mark.parametrize("reference", ["tiny@1", "tiny@champion"])
def test_a_published_bob(run, registry, reference):
    bob = load_bob(reference, registry)
    assert bob.label == "tiny@1"
    assert bob.config == tiny_config()
    assert bob.manifest == Registry(registry).manifest("tiny@1")
    rows = observations(BOB.size)
    expected = NumpyMCPPolicy(run[1].weights().bob).act_deterministic(rows)
    assert np.array_equal(bob.policy.act_deterministic(rows), expected)


def test_a_name_the_registry_does_not_have_is_that_of_the_package(registry):
    bob = load_bob("panda-cube@champion", registry)
    manifest = Registry(BUNDLED).manifest("panda-cube@champion")
    assert (bob.label, bob.manifest) == (f"{manifest.reference} (bundled)", manifest)
    assert isinstance(bob.primitives, NumpyMCPPolicy)


def test_both_players(run):
    path, learner = run
    alice, bob = load_players(RunDirectory(path))
    weights = learner.weights()
    rows = observations(FULL.size)
    assert np.array_equal(alice.act_deterministic(rows), NumpyGaussianPolicy(weights.alice).act_deterministic(rows))
    rows = observations(BOB.size)
    assert np.array_equal(bob.act_deterministic(rows), NumpyMCPPolicy(weights.bob).act_deterministic(rows))


def test_parameters_are_those_of_the_player_alone(run):
    path, learner = run
    parameters = read_parameters(RunDirectory(path), "alice")
    assert parameters.keys() == learner.weights().alice.keys()


@pytest.mark.parametrize(
    ("reference", "parts"),
    [
        ("tiny@best", ["no alias 'best'", "latest -> 2"]),
        ("tiny@9", ["no version 9"]),
        ("nobody", ["no 'nobody'", "it holds: tiny", "with tandem comes: panda-cube"]),
        ("no/such/run", ["no/such/run", "no such run directory", "NAME@ALIAS"]),
        ("Tiny!", ["bad reference 'Tiny!'"]),
    ],
)
def test_nobody_there(registry, reference, parts):
    with pytest.raises(TandemError) as error:
        load_bob(reference, registry)
    assert_one_line(error.value, *parts)


def test_a_directory_without_a_run(tmp_path):
    with pytest.raises(TandemError) as error:
        load_bob(str(tmp_path), tmp_path)
    assert_one_line(error.value, "no run in", tmp_path)
    (tmp_path / "cell.json").touch()
    with pytest.raises(TandemError) as error:
        load_bob(str(tmp_path), tmp_path)
    assert_one_line(error.value, "is a downstream training", "tandem downstream evaluate, render, play or publish")


def test_a_run_without_a_checkpoint(tmp_path):
    directory = RunDirectory(tmp_path)
    directory.start(tiny_config())
    directory.close()
    with pytest.raises(TandemError) as error:
        load_bob(str(tmp_path), tmp_path)
    assert_one_line(error.value, "no checkpoint", tmp_path)


def test_a_checkpoint_of_another_format(tmp_path, monkeypatch):
    directory = RunDirectory(tmp_path)
    directory.start(tiny_config())
    directory.close()
    monkeypatch.setattr(checkpoints, "FORMAT_VERSION", 99)
    checkpoints.CheckpointStore(directory.checkpoints, keep=1).save(4, {}, {})
    monkeypatch.undo()
    with pytest.raises(TandemError) as error:
        load_bob(str(tmp_path), tmp_path)
    assert_one_line(error.value, "checkpoint-00000004", "format version 99", "reads 1")


def test_parameters_of_another_policy_are_the_users_mistake(registry):
    with pytest.raises(TandemError) as error:
        load_bob("tiny@2", registry)
    assert_one_line(error.value, "tiny@2")


def test_primitives_of_a_configuration_of_another_time(run, tmp_path):
    config = tiny_config().model_dump(mode="json") | {"worlds": {}}
    common = {"spaces": {}, "normalisation": {}, "metrics": {}}
    Registry(tmp_path).publish("tiny", run[1].weights().bob, config=config, **common)
    with pytest.raises(TandemError) as error:
        load_bob("tiny", tmp_path)
    assert_one_line(error.value, "the manifest of tiny", "'worlds'")
