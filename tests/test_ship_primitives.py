"""Putting a champion into a bundled registry, which here is another directory."""

import json
import shutil
import sys

import numpy as np
import pytest

from service.actors.evaluation import EVALUATION_SEED, evaluate
from service.base.errors import TandemError
from service.config import dump_config, parse_config
from service.policies.numpy_policy import numpy_bob
from service.registry.loading import load
from service.registry.publishing import publish
from service.registry.registry import Registry
from service.runs.train import publish_learned
from service.store.run_directory import RunDirectory
from tests.registry.helpers import assert_identical, files_in
from tests.runs.runs import TREE, assert_one_line, play, tiny_config
from tools import ship_primitives
from tools.ship_primitives import ship


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """The directory of a short run."""
    path = tmp_path_factory.mktemp("ship") / "run"
    play(path, tiny_config(total_env_steps=400))
    return RunDirectory(path)


@pytest.fixture
def registry(run, tmp_path):
    """A registry with the run's Bob as version 1 and 2, and as the only version of another name."""
    registry = Registry(tmp_path / "registry")
    bob = load(str(run.path)).parameters
    first = publish(registry, tiny_config(), bob, {"score": 0.25})
    changed = bob | {"gate.output.bias": bob["gate.output.bias"] + 1.0}
    publish(registry, tiny_config(), changed, {"score": 0.5}, parent=first)
    other = {"gate.output.bias": bob["gate.output.bias"] + 2.0}
    publish(registry, tiny_config().model_copy(update={"name": "other"}), bob | other, {})
    return registry


@pytest.fixture
def target(tmp_path):
    return tmp_path / "bundled"


def test_what_is_shipped_is_what_was_published(registry, target):
    assert str(ship("tiny@2", registry, target)) == "tiny@1"
    manifest, parameters = Registry(target).load("tiny@champion")
    original, expected = registry.load("tiny@2")
    assert_identical(parameters, expected)
    assert manifest == original.model_copy(update={"version": 1, "parent": None})
    assert load("tiny@latest", target).config.policy == tiny_config().policy
    assert Registry(target).verify() == []
    assert list(target.rglob(".*")) == []


def test_the_version_before_goes_and_other_names_stay(registry, target):
    for reference in ("tiny@1", "other", "tiny@2"):
        ship(reference, registry, target)
    bundled = Registry(target)
    assert [str(version) for name in bundled.names() for version in bundled.versions(name)] == ["other@1", "tiny@2"]
    assert bundled.aliases("tiny") == {"champion": 2, "latest": 2}
    assert bundled.verify() == []
    sources = {registry.manifest(reference).blob_sha256 for reference in ("tiny@2", "other")}
    assert {path.name for path in (target / "blobs" / "sha256").iterdir()} == sources


def test_a_damaged_version_is_not_shipped(registry, target):
    digest = registry.manifest("tiny@1").blob_sha256
    (registry.root / "blobs" / "sha256" / digest).write_bytes(b"x")
    ship("tiny@2", registry, target)
    before = files_in(target)
    with pytest.raises(TandemError) as error:
        ship("tiny@1", registry, target)
    assert_one_line(error.value, "is damaged", digest)
    assert files_in(target) == before


@pytest.mark.parametrize(
    ("changes", "part"),
    [
        ({"spaces": {"made": [{"in": "/somewhere/runs"}]}}, "'/somewhere/runs'"),
        ({"config": TREE | {"world": {"worlds": {}}}}, "'world.worlds'"),
        ({"parameters": {"a": np.zeros(1, np.float32)}}, "primitives"),
    ],
)
def test_what_nobody_else_could_use_is_not_shipped(run, registry, target, changes, part):
    fields = {"spaces": {}, "normalisation": {}, "config": TREE, "metrics": {}} | changes
    parameters = fields.pop("parameters", None) or load(str(run.path)).parameters
    registry.publish("tiny", parameters, **fields)
    with pytest.raises(TandemError) as error:
        ship("tiny@3", registry, target)
    assert_one_line(error.value, part)
    assert not target.exists()


def test_the_newest_bob_of_a_run_is_measured(run, tmp_path, monkeypatch):
    registry, near = Registry(tmp_path / "registry"), RunDirectory(tmp_path / "run")
    shutil.copytree(run.path, near.path)
    more = {"final_episodes": 40}
    game = {"success_distance_m": 0.05}  # this Bob solves nothing by less
    tree = TREE | {"game": TREE["game"] | game, "run": TREE["run"] | more}
    near.config_file.write_text(dump_config(parse_config(tree, where="a test")))
    assert str(publish_learned(near.path, registry.root)) == "tiny@1"
    manifest, parameters = registry.load("tiny")
    assert_identical(parameters, load(str(run.path)).parameters)
    env_steps = json.loads(run.metrics_file.read_text().splitlines()[-1])["env_steps"]
    config = near.read_config()
    for kind in ("mixed", "air", "table"):
        found = evaluate(
            numpy_bob(parameters),
            config.world,
            kind,
            num_episodes=40,
            num_steps=config.run.evaluation_steps,
            success_distance_m=config.game.success_distance_m,
            seed=EVALUATION_SEED + 1,
        )
        assert manifest.metrics[f"evaluation/{kind}_success_last"] == found.success_last
        assert manifest.metrics[f"evaluation/{kind}_success_ever"] == found.success_ever
    assert manifest.metrics["env_steps"] == env_steps
    assert 0.0 < manifest.metrics["evaluation/mixed_success_last"] < 1.0  # else any goals would do


def test_one_command(registry, target, monkeypatch, capsys):
    def tandem_ships(*arguments):
        monkeypatch.setattr(sys, "argv", ["ship_primitives", *map(str, arguments)])
        return ship_primitives.main()

    monkeypatch.setattr(ship_primitives, "BUNDLED", target)
    assert tandem_ships("tiny@2", "--registry", registry.root) == 0
    assert f"tiny@1 is in {target}" in capsys.readouterr().out
    assert Registry(target).manifest("tiny@champion").metrics == {"score": 0.5}
    before = files_in(target)
    assert tandem_ships("nobody", "--registry", registry.root) == 2
    assert_one_line(capsys.readouterr().err, "error: no 'nobody'")
    assert files_in(target) == before
