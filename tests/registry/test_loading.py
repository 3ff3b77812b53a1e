"""``load``: every kind of reference, and every kind of what is none."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from service.base.errors import TandemError
from service.envs.observations import BOB, PAPER
from service.envs.task import Task
from service.export.exporting import export
from service.policies.numpy_policy import NumpyGaussianPolicy, NumpyMCPPolicy
from service.registry.bundled import BUNDLED
from service.registry.loading import load
from service.registry.publishing import publish
from service.registry.registry import Registry
from service.store import checkpoints
from service.store.run_directory import RunDirectory
from tests.export.policies import publish_bob, write_training
from tests.methods import skill_sets
from tests.runs.runs import assert_one_line, play, tiny_config
from tests.status.conftest import serve


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """(directory, learner) of a short run."""
    path = tmp_path_factory.mktemp("primitives") / "run"
    run, _ = play(path, tiny_config(total_env_steps=400, checkpoint_interval=1))
    return path, run.method.learner


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
    bob = load(path, tmp_path)
    assert bob.label == str(path)
    assert bob.manifest is None
    assert bob.config == tiny_config(total_env_steps=400, checkpoint_interval=1)
    rows = observations(BOB.size)
    expected = NumpyMCPPolicy(learner.weights().bob).act_deterministic(rows)
    assert np.array_equal(bob.policy.act_deterministic(rows), expected)


def test_a_manifest_of_version_0_1_0(run, tmp_path):
    """It came with that package. Its world is read, and not the keys of its learner, which are gone."""
    written = json.loads(Path(__file__).with_name("manifest_0_1_0.json").read_text())
    assert written["config"]["learner"]["alice_interval"] == 1
    kept = {key: written[key] for key in ("spaces", "normalisation", "config", "metrics")}
    Registry(tmp_path).publish("old", run[1].weights().bob, **kept)
    bob = load("old@1", tmp_path)
    assert (bob.config.world.num_substeps, bob.config.game.bob_steps) == (8, 40)
    assert bob.config.policy.bob.log_std_min == written["config"]["policy"]["bob"]["log_std_min"]
    assert bob.manifest.config == written["config"]


def test_of_a_published_configuration_only_what_acts_is_read(run, tmp_path):
    config = tiny_config().model_dump(mode="json")
    config["world"]["object"], config["game"]["success_distance_m"] = "sphere", 0.04
    config["learner"], config["game"]["gone"], config["run"]["total_env_steps"] = 7, "x", "many"
    common = {"spaces": {}, "normalisation": {}, "metrics": {}}
    Registry(tmp_path).publish("other", run[1].weights().bob, config=config, **common)
    found = load("other@1", tmp_path).config
    assert (found.world.object, found.game.success_distance_m, found.run.evaluation_steps) == ("sphere", 0.04, 2)
    Registry(tmp_path).publish("other", run[1].weights().bob, config=config | {"world": {"gone": 1}}, **common)
    with pytest.raises(TandemError) as error:
        load("other@2", tmp_path)
    assert_one_line(error.value, "the manifest of other@2", "unknown key 'world.gone'")


@pytest.mark.parametrize("version", ["0.1.0", "0.2.0"])
def test_a_run_of_before_names_the_version_that_reads_it(run, tmp_path, version):
    path = shutil.copytree(run[0], tmp_path / "run")
    identity = json.loads((path / "run.json").read_text())
    del identity["tandem"]  # 0.2.0 wrote none, 0.1.0 not even the file
    (path / "run.json").write_text(json.dumps(identity))
    if version == "0.1.0":
        (path / "run.json").unlink()
    with pytest.raises(TandemError) as error:
        load(str(path))
    assert_one_line(error.value, path, "of another version of tandem, which this one does not read: use tandem 0.2")


@pytest.mark.parametrize("reference", ["tiny@1", "tiny@champion"])
def test_a_published_bob(run, registry, reference):
    bob = load(reference, registry)
    assert bob.label == "tiny@1"
    assert (bob.config.world, bob.config.policy) == (tiny_config().world, tiny_config().policy)
    assert bob.manifest == Registry(registry).manifest("tiny@1")
    rows = observations(BOB.size)
    expected = NumpyMCPPolicy(run[1].weights().bob).act_deterministic(rows)
    assert np.array_equal(bob.policy.act_deterministic(rows), expected)


def test_a_name_the_registry_does_not_have_is_that_of_the_package(registry):
    bob = load("panda-cube@champion", registry)
    manifest = Registry(BUNDLED).manifest("panda-cube@champion")
    assert (bob.label, bob.manifest) == (f"{manifest.reference} (bundled)", manifest)
    assert isinstance(bob.primitives, NumpyMCPPolicy)


def test_a_run_has_both_players_and_what_another_run_begins_from(run):
    path, learner = run
    found, weights = load(str(path)), learner.weights()
    rows = observations(PAPER.full.size)
    expected = NumpyGaussianPolicy(weights.alice).act_deterministic(rows)
    assert np.array_equal(found.alice.act_deterministic(rows), expected)
    assert found.parameters.keys() == weights.bob.keys()
    assert sorted(found.networks) == ["alice/policy", "alice/value", "bob/policy", "bob/value"]
    assert (found.kind, found.name, found.published) == ("primitives", "tiny of the run run", None)


def test_a_checkpoint_and_a_snapshot_of_a_run(run, tmp_path, monkeypatch):
    path, learner = run
    newest = checkpoints.CheckpointStore(path / "checkpoints", keep=1).newest()
    monkeypatch.chdir(newest.parent)
    found, rows = load(newest.name), observations(BOB.size)
    assert (found.reference, found.name) == (str(newest), f"tiny of the run run, {newest.stem}")
    expected = NumpyMCPPolicy(learner.weights().bob).act_deterministic(rows)
    assert np.array_equal(found.act_deterministic(rows), expected)
    first = load(str(min((path / "snapshots").iterdir())))
    assert not np.array_equal(first.act_deterministic(rows), expected)
    assert first.networks.keys() == {"bob/policy"}


def test_an_exported_version(registry, tmp_path, monkeypatch):
    Registry(registry).export("tiny@1", tmp_path / "exported")
    monkeypatch.chdir(tmp_path)
    found, own = load("exported", "no registry here"), load("tiny@1", registry)
    assert (found.manifest, found.name, found.reference) == (own.manifest, "tiny@1", str(tmp_path / "exported"))
    assert own.reference == "tiny@1"


def test_every_kind_from_a_service_as_from_its_registry(tmp_path, monkeypatch):
    """A URL needs neither torch nor what serves it; see test_client for that."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    (tmp_path / "runs").mkdir()
    registry = Registry(tmp_path / "registry")
    bob = publish_bob(registry)
    publish(registry, skill_sets.CONFIG.model_copy(update={"name": "skills"}), skill_sets.parameters(), {})
    write_training(tmp_path / "training", bob, "ours", "wall")
    rows = observations(22)
    with serve(tmp_path) as server:
        fetched, skills = load("made", server.url), load("skills@1", server.url)
        training = load(str(tmp_path / "training"), server.url)  # what it acts with comes from there
        with pytest.raises(TandemError) as error:
            load("nobody@1", server.url)
    assert_one_line(error.value, server.url, "no 'nobody'")
    assert np.array_equal(fetched.act_deterministic(rows), bob.act_deterministic(rows))
    assert (fetched.kind, skills.kind, training.kind) == ("primitives", "skills", "orchestrator")
    assert (training.acts_with.label, training.task.name, training.world.fixture) == ("made@1", "wall", "wall")
    assert training.primitives is training.acts_with.policy
    local = load(str(tmp_path / "training"), registry.root)
    assert np.array_equal(training.player().act_deterministic(rows), local.player().act_deterministic(rows))


@pytest.fixture
def kinds(tmp_path):
    """Primitives, skills, and two policies of a task: that composes primitives, and that acts by itself."""
    registry = Registry(tmp_path / "registry")
    bob = publish_bob(registry)
    for method in ("ours", "scratch-monolithic"):
        write_training(tmp_path / method, bob, method)
    return {
        "primitives": bob,
        "skills": skill_sets.made(),
        "task": load(str(tmp_path / "ours"), registry.root),
        "alone": load(str(tmp_path / "scratch-monolithic"), registry.root),
    }


def test_an_evaluation_leaves_the_episodes_that_somebody_plays(kinds):
    for kind, size in (("task", 22), ("skills", BOB.size)):
        rows = observations(size)
        playing, alone = kinds[kind], kinds[kind].player()
        playing.begin()
        for each in (playing, alone):
            each.act_deterministic(rows)
        playing.player().act_deterministic(rows[:2] + 1.0)
        expected = np.clip(alone.act_deterministic(rows + 0.1), -1.0, 1.0)
        np.testing.assert_array_equal(playing.act_deterministic(rows + 0.1), expected)


def test_actions_are_within_their_bounds(champion):
    rows = np.concatenate((observations(BOB.size), 9.0 * observations(BOB.size)))
    raw, given = champion.policy.act_deterministic(rows), champion.act_deterministic(rows)
    assert np.abs(raw).max() > 1.0
    np.testing.assert_array_equal(given, np.clip(raw, -1.0, 1.0))


def test_the_nominal_world_of_a_task_draws_nothing(kinds):
    task = Task("Heavy", world={"randomisation": {"object_mass_kg": (0.05, 0.3)}, "friction": 0.7})
    drawn = kinds["primitives"].playing(task)
    assert drawn.world.randomisation.model_ranges == {"object_mass_kg": (0.05, 0.3)}
    assert drawn.nominal.world.randomisation.model_ranges == {}
    assert drawn.nominal.world.friction == 0.7


def test_what_each_kind_has(kinds):
    bob, skills, task, alone = kinds.values()
    for each, said in (
        (skills, "made@1 has no primitives: it is a set of sk"),
        (alone, "has no primitives: "),
    ):
        with pytest.raises(TandemError, match=said):
            _ = each.primitives
    for each in (bob, task, alone):
        with pytest.raises(TandemError, match="has no skills: it is a "):
            _ = each.skills
    assert (bob.goal_kind, bob.num_steps, bob.success_distance_m) == ("mixed", 4, bob.config.game.success_distance_m)
    assert (task.goal_kind, task.num_steps, task.success_distance_m) == ("table", 50, 0.05)
    assert task.world.gripper == "blocked"
    assert alone.acts_with is None
    assert alone.config.world == bob.config.world
    assert (bob.on("wall").title, bob.on("wall").world.fixture) == ("made@1 on Wall", "wall")
    with pytest.raises(TandemError, match="unknown task 'lift'"):
        _ = bob.on("lift").world


def test_the_digest_is_that_of_what_acts(kinds):
    assert len({each.digest for each in kinds.values()}) == 4
    assert kinds["skills"].digest == skill_sets.made().digest != skill_sets.made(seed=6).digest


@pytest.mark.parametrize(
    ("kind", "needed", "said"),
    [
        ("skills", ["primitives"], "made@1 is a set of skills of lsd; tandem x needs primitives"),
        (
            "primitives",
            ["skills", "orchestrator"],
            "a set of primitives; tandem x needs skills or a policy of a task",
        ),
        (
            "task",
            ["primitives"],
            "policy of the task push; tandem x needs primitives: name made@1, which it acts with",
        ),
        ("alone", ["primitives", "skills"], "is a policy of the task push; tandem x needs primitives or skills"),
    ],
)
def test_another_kind_than_is_needed(kinds, kind, needed, said):
    with pytest.raises(TandemError) as error:
        kinds[kind].expect(*needed, by="tandem x")
    assert_one_line(error.value, said)
    assert kinds[kind].expect(kinds[kind].kind, by="tandem x") is kinds[kind]


def test_skills_that_no_goal_leads():
    with pytest.raises(TandemError, match="skills of dads, which no goal leads; tandem play needs a policy with goals"):
        skill_sets.made("dads").expect_goals("tandem play")
    assert skill_sets.made("metra").expect_goals("tandem play").policy.begin() is None


LIGHT = """
import sys
from service.registry.loading import load
for reference in sys.argv[2:]:
    load(reference, sys.argv[1])
print({"torch", "mujoco", "ray", "fastapi", "httpx", "gymnasium"} & set(sys.modules))
"""


def test_nothing_heavy_is_imported_to_act(run, tmp_path):
    registry = Registry(tmp_path / "registry")
    write_training(tmp_path / "training", publish_bob(registry))
    publish(registry, skill_sets.CONFIG.model_copy(update={"name": "skills"}), skill_sets.parameters(), {})
    references = ["panda-cube@champion", "made@1", "skills", tmp_path / "training", run[0]]
    done = subprocess.run(
        [sys.executable, "-c", LIGHT, registry.root, *references],
        cwd=Path(__file__).parents[2], capture_output=True, text=True, timeout=600,
    )  # fmt: skip
    assert (done.returncode, done.stdout) == (0, "set()\n"), done.stderr


def test_a_version_of_a_kind_that_is_not_known(registry):
    common = {"normalisation": {}, "config": tiny_config().model_dump(mode="json"), "metrics": {}}
    Registry(registry).publish("later", {"weight": np.zeros(2, np.float32)}, spaces={"kind": "diffusion"}, **common)
    with pytest.raises(TandemError) as error:
        load("later", registry)
    assert_one_line(error.value, "later@1 is of the kind 'diffusion'", "newer")


@pytest.mark.parametrize(
    ("reference", "parts"),
    [
        ("tiny@best", ["no alias 'best'", "latest -> 2"]),
        ("tiny@9", ["no version 9"]),
        ("nobody", ["no 'nobody'", "it holds: tiny", "with tandem comes: panda-cube"]),
        ("no/such/run", ["no/such/run", "no such directory of a run", "NAME@ALIAS"]),
        ("Tiny!", ["bad reference 'Tiny!'"]),
        ("lift.py:LIFT", ["lift.py:LIFT is code", "name a task by --task lift.py:LIFT"]),
    ],
)
def test_nobody_there(registry, reference, parts):
    with pytest.raises(TandemError) as error:
        load(reference, registry)
    assert_one_line(error.value, *parts)


def test_a_directory_without_a_run(tmp_path):
    with pytest.raises(TandemError) as error:
        load(str(tmp_path), tmp_path)
    assert_one_line(error.value, "no run in", tmp_path)
    (tmp_path / "notes.safetensors").touch()
    with pytest.raises(TandemError) as error:
        load(str(tmp_path / "notes.safetensors"), tmp_path)
    assert_one_line(error.value, "no checkpoint of a run")
    export(load("panda-cube@champion"), "numpy", tmp_path / "elsewhere", part="policy", num_episodes=2)
    with pytest.raises(TandemError) as error:
        load(str(tmp_path / "elsewhere"))
    assert_one_line(error.value, "elsewhere is a folder of tandem export", "name what it was made of")
    with pytest.raises(TandemError) as error:
        load("panda-cube@champion", primitives="panda-cube@1")
    assert_one_line(error.value, "acts with nothing else: leave out primitives 'panda-cube@1'")


def test_a_run_without_a_checkpoint(tmp_path):
    directory = RunDirectory(tmp_path)
    directory.start(tiny_config())
    directory.close()
    with pytest.raises(TandemError) as error:
        load(str(tmp_path), tmp_path)
    assert_one_line(error.value, "no checkpoint", tmp_path)


def test_a_checkpoint_of_another_format(tmp_path, monkeypatch):
    directory = RunDirectory(tmp_path)
    directory.start(tiny_config())
    directory.close()
    monkeypatch.setattr(checkpoints, "FORMAT_VERSION", 99)
    checkpoints.CheckpointStore(directory.checkpoints, keep=1).save(4, {}, {})
    monkeypatch.undo()
    with pytest.raises(TandemError) as error:
        load(str(tmp_path), tmp_path)
    assert_one_line(error.value, "checkpoint-00000004", "format version 99", "reads 1")


def test_parameters_of_another_policy_are_the_users_mistake(registry):
    with pytest.raises(TandemError) as error:
        load("tiny@2", registry)
    assert_one_line(error.value, "tiny@2")
