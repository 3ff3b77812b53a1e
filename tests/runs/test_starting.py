"""Runs that begin from what another one learned, in worlds that draw their physics and show last commands."""

import logging
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from service.base.errors import StorageError, TandemError
from service.config import parse_config
from service.policies.numpy_policy import numpy_bob
from service.registry.loading import load
from service.registry.publishing import publish, publish_run
from service.registry.registry import Registry
from service.runs.train import Runtime, open_run, train
from service.store import run_directory
from service.store.run_directory import RunDirectory
from tests.runs.runs import TREE, assert_same_run, play, tiny_config

DRAWN = {"num_models": 3, "friction": [0.5, 1.0], "delay_steps": [0, 1], "object_noise_m": [0.0, 0.005]}
WORLD = TREE["world"] | {"observed": {"num_commands": 2}, "randomisation": DRAWN}


def wider_config(**run):
    return parse_config(TREE | {"name": "wider", "world": WORLD, "run": TREE["run"] | run}, where="a test")


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A tiny run, published."""
    root = tmp_path_factory.mktemp("trained")
    run, _ = play(root / "run")
    run.close()
    version = publish_run(run.directory, Registry(root / "registry"), run.config, run.method.parameters(), {})
    return root, run.directory, version


def test_a_version_whose_publisher_was_cut_off_becomes_the_latest(tmp_path, monkeypatch):
    run, _ = play(tmp_path / "run")
    registry, found = Registry(tmp_path / "registry"), load(str(tmp_path / "run"))

    def cut_off(*_, **__):
        raise StorageError("the disk is full")

    with monkeypatch.context() as patch:
        patch.setattr(Registry, "_move_alias", cut_off)
        with pytest.raises(StorageError):
            publish_run(run.directory, registry, found.config, found.parameters, {})
    assert (len(registry.versions("tiny")), registry.aliases("tiny")) == (1, {})
    published = publish_run(run.directory, registry, found.config, found.parameters, {})
    assert (len(registry.versions("tiny")), registry.aliases("tiny")) == (1, {"latest": published.number})


def test_a_start_that_was_cut_off_can_be_tried_again(tmp_path, monkeypatch):
    """The configuration comes last, so all else that a start writes is there."""

    def cut_off(path, *_):
        if path.name == "config.yaml":
            raise StorageError("the disk is full")

    with monkeypatch.context() as patch, closing(RunDirectory(tmp_path / "run")) as directory:
        patch.setattr(run_directory, "write_atomic", cut_off)
        with pytest.raises(StorageError):
            open_run(tiny_config(), directory)
    (tmp_path / "run" / "stop").touch()  # it was asked to stop meanwhile
    left = {path.name for path in (tmp_path / "run").iterdir()}
    assert {"checkpoints", "snapshots", "epochs", "tensorboard"} < left
    _, ended = play(tmp_path / "run")
    assert ended.reason == "finished"


@pytest.mark.parametrize(("registry", "served"), [("http://host:8321", "registry"), ("elsewhere", "elsewhere")])
def test_a_service_beside_a_run_has_the_usual_registry_where_primitives_come_by_http(tmp_path, registry, served):
    found = []

    class Beside(Runtime):
        def around(self, directory, registry, end_now):
            found.append(registry)
            raise TandemError("seen")

    with pytest.raises(TandemError, match="seen"):
        train(
            tiny_config(), RunDirectory(tmp_path / "run"), registry,
            publish=False, on_iteration=lambda _: None, runtime=Beside(),
        )  # fmt: skip
    assert found == [Path(served)]


def test_a_run_with_more_to_see_is_exact_when_resumed(tmp_path):
    config = wider_config(total_env_steps=400)
    play(tmp_path / "whole", config)
    play(tmp_path / "killed", config, kill_after=2)
    play(tmp_path / "killed", config, resume=True)
    assert_same_run(tmp_path / "killed", tmp_path / "whole")


def test_from_a_version_bob_is_taken_and_it_is_the_parent(trained, tmp_path, caplog):
    root, _, version = trained
    start = load(str(version), root / "registry")
    with caplog.at_level(logging.INFO):
        run = open_run(wider_config(), RunDirectory(tmp_path / "run"), start=start)
    run.close()
    assert "bob/policy: taken: new command_1, command_2" in caplog.text
    assert "alice/policy: nothing there, begins anew" in caplog.text
    registry = Registry(root / "registry")
    published = publish_run(run.directory, registry, run.config, run.method.parameters(), {})
    assert registry.manifest(str(published)).parent == str(version)
    bob = load(str(published), root / "registry")
    assert bob.primitives.num_positions == 19
    assert bob.manifest.spaces["observation"] == 22


def test_from_a_run_directory_all_four_networks_are_taken(trained, tmp_path):
    _, directory, _ = trained
    start = load(str(directory.path))
    new = open_run(tiny_config(seed=5), RunDirectory(tmp_path / "new"), start=start)
    new.close()
    old = open_run(tiny_config(), directory, resume=True)
    old.close()
    ours, theirs = new.method.learner.state(), old.method.learner.state()
    networks = [name for name in theirs if "adam" not in name and ("/policy/" in name or "/value/" in name)]
    assert len(networks) > 20
    for name in networks:
        np.testing.assert_array_equal(ours[name], theirs[name], err_msg=name)
    observation = np.random.default_rng(0).normal(size=(4, 14)).astype(np.float32)
    published = load(str(tmp_path / "new"))
    np.testing.assert_allclose(
        published.policy.act_deterministic(observation),
        numpy_bob(new.method.learner.weights().bob).act_deterministic(observation),
    )


def test_only_the_value_network_learns_at_first(tmp_path):
    tree = TREE | {"learner": {**TREE["learner"], "bob": {**TREE["learner"]["bob"], "value_first_updates": 100}}}
    run = open_run(parse_config(tree, where="a test"), RunDirectory(tmp_path / "run"))
    before = {name: array.copy() for name, array in run.method.learner.state().items()}
    run.run()
    after = run.method.learner.state()
    run.close()
    changed = {name for name in before if name in after and not np.array_equal(before[name], after[name])}
    assert not {name for name in changed if name.startswith("bob/policy/")}
    assert {name for name in changed if name.startswith("bob/value/")}
    assert {name for name in changed if name.startswith("alice/policy/")}


def test_nothing_that_fits_is_refused_and_another_try_can_begin(trained, tmp_path):
    root, _, version = trained
    start = load(str(version), root / "registry")
    larger = tiny_config(seed=5)
    bob = larger.policy.bob.model_copy(update={"primitive_hidden_size": larger.policy.bob.primitive_hidden_size + 1})
    larger = larger.model_copy(update={"policy": larger.policy.model_copy(update={"bob": bob})})
    directory = RunDirectory(tmp_path / "run")
    with pytest.raises(TandemError, match=r"^--from tiny@1: nothing of it fits: bob/policy: not taken, .* is of shape"):
        open_run(larger, directory, start=start)
    directory.close()
    open_run(tiny_config(seed=5), RunDirectory(tmp_path / "run"), start=start).close()


def test_from_an_exported_version(trained, tmp_path, monkeypatch):
    root, _, version = trained
    Registry(root / "registry").export(str(version), tmp_path / "exported")
    monkeypatch.chdir(tmp_path)
    start = load("exported", tmp_path / "empty")
    assert start.reference == str(tmp_path / "exported")
    assert start.published.version == str(version)
    assert start.networks.keys() == {"bob/policy"}


def test_a_version_that_came_with_tandem_is_the_parent_in_any_registry(trained, tmp_path, monkeypatch):
    """But not where that registry has another version of that name and number."""
    root, _, version = trained
    monkeypatch.setattr("service.registry.bundled.BUNDLED", root / "registry")
    start = load("tiny", tmp_path / "empty")
    assert start.reference == str(version) == "tiny@1"
    run = open_run(wider_config(), RunDirectory(tmp_path / "run"), start=start)
    run.close()
    parents = []
    for name in ("other", "taken"):
        registry = Registry(tmp_path / name)
        if name == "taken":
            publish(registry, tiny_config(), run.method.parameters(), {})
        run.directory.write_published(start.published)
        published = publish_run(run.directory, registry, run.config, run.method.parameters(), {})
        parents.append(registry.manifest(str(published)).parent)
    assert parents == ["tiny@1", None]


def test_what_was_published_once_is_not_published_again_after_another_run(trained):
    """Or who resumes a finished run takes latest back to an older policy."""
    root, directory, version = trained
    registry, mine = Registry(root / "registry"), load(str(version), root / "registry")
    other, _ = play(root / "other", tiny_config(seed=1))
    other.close()
    later = publish_run(other.directory, registry, other.config, other.method.parameters(), {})
    assert publish_run(directory, registry, mine.config, mine.parameters, {}) == version
    assert registry.aliases(version.name)["latest"] == later.number


def test_a_run_does_not_begin_in_the_directory_of_a_study(tmp_path):
    (tmp_path / "study.json").write_text("{}")
    with pytest.raises(TandemError, match="holds a study; name another --run-dir"):
        play(tmp_path)
