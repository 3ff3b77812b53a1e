"""Learning a task: a run like any other, which can be stopped, killed, resumed, loaded and published."""

import json
import shutil

import httpx
import numpy as np
import pytest

import service
from service.actors.evaluation import IdlePolicy, evaluate
from service.base.errors import TandemError
from service.config.find import METHODS as KNOWN
from service.config.task import TaskConfig
from service.config.task_methods import TASK_METHODS
from service.envs.observations import layouts
from service.envs.tasks import find_task
from service.methods import task_evaluation
from service.methods.task import TaskLearning
from service.registry.bundled import BUNDLED
from service.registry.loading import network_problems
from service.registry.publishing import publish
from service.registry.registry import Registry
from service.robot.running import for_robot
from service.runs.resuming import resumed_config
from service.runs.train import train
from service.store.models import read_status
from service.store.run_directory import RunDirectory
from tests.methods import skill_sets
from tests.methods.trials import small_trial
from tests.registry.helpers import files_in
from tests.runs.runs import KilledError, assert_one_line, assert_same_run, newest, read_lines
from tests.status.conftest import serve

pytestmark = pytest.mark.usefixtures("default_signals", "no_video")


@pytest.fixture(scope="module")
def no_video():
    """Without a video, which takes seconds, and OpenGL."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("service.media.video.write_episode_video", lambda episodes, world, path, options: path)
        yield


def ignore(metrics):
    pass


def begin(path, config, registry, on_iteration=ignore, *, publish=False):
    return train(config.begin(registry, None), RunDirectory(path), registry, publish=publish, on_iteration=on_iteration)


def go_on(path, registry, on_iteration=ignore, *, publish=False):
    """As ``--resume`` does, with nothing else said."""
    directory = RunDirectory(path)
    config = resumed_config(directory, [])
    return train(config, directory, registry, resume=True, publish=publish, on_iteration=on_iteration)


@pytest.fixture(scope="module")
def home(tmp_path_factory, champion, no_video):
    """A directory with the runs of an orchestrator, which is published, and of a policy from nothing."""
    home = tmp_path_factory.mktemp("tasks")
    for method in ("ours", "scratch-monolithic"):
        done = begin(home / "runs" / method, small_trial(method), home / "registry", publish=method == "ours")
        assert done.reason == "finished"
    return home


# --- a run -----------------------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("no_artifacts")
@pytest.mark.parametrize("method", ["ours-her", "lsd"])
def test_a_killed_run_is_resumed_as_the_uninterrupted_one(tmp_path, method):
    registry, config = tmp_path / "registry", small_trial(method)
    if method == "lsd":
        publish(Registry(registry), skill_sets.CONFIG, skill_sets.parameters(), {})
        config = small_trial(method, primitives="made")

    def kill(metrics):
        if metrics["iteration"] == 3:
            raise KilledError

    whole = begin(tmp_path / "whole", config, registry)
    with pytest.raises(KilledError):
        begin(tmp_path / "cut", config, registry, kill)
    assert newest(tmp_path / "cut").step == 2
    assert RunDirectory(tmp_path / "cut").read_result() is None
    np.random.seed(99)
    resumed = go_on(tmp_path / "cut", registry)
    assert_same_run(tmp_path / "whole", tmp_path / "cut")
    assert {"loop/learner/alpha/log", "loop/replay/goal", "loop/worlds/worlds"} < newest(tmp_path / "cut").arrays.keys()
    assert resumed.metrics == whole.metrics


def test_what_it_leaves(home, champion):
    path = home / "runs" / "ours"
    assert {"config.yaml", "metrics.jsonl", "tensorboard", "checkpoints", "result.json", "curves.png", "log.jsonl"} < {
        file.name for file in path.iterdir()
    }
    rows, result = read_lines(path / "metrics.jsonl"), RunDirectory(path).read_result()
    assert [row["env_steps"] for row in rows if "evaluation/success_last" in row] == [400]
    assert rows[-1]["learner/num_updates"] == 2 * 50 * 2  # two iterations that learn, 50 steps each, two updates a step
    assert {"rollout/return", "rollout/success_last", "rollout/success_ever"} < rows[-1].keys()
    assert result["env_steps"] == 600
    assert result == json.loads((path / "result.json").read_text())
    found = result["evaluation"]
    assert found["num_episodes"] == 6
    for key in ("success_last", "success_ever"):
        share = found[key]
        for bound in (found[f"{key}_low"], found[f"{key}_high"]):  # Wilson's: where the share is 1.96 deviations away
            assert (share - bound) ** 2 == pytest.approx(1.96**2 * bound * (1.0 - bound) / 6, abs=1e-12)
    config, trial = RunDirectory(path).read_config(), read_status(path).trial
    assert (config.primitives, config.primitives_digest) == (champion.manifest.reference, champion.digest)
    assert (config.world, config.task_version) == (champion.config.world, find_task("push").version)
    assert (trial.task, trial.method, trial.primitives) == ("push", "ours", champion.manifest.reference)


@pytest.mark.usefixtures("no_artifacts")
def test_a_run_that_has_ended_is_measured_again_and_published_by_a_resume(home, tmp_path):
    path = shutil.copytree(home / "runs" / "ours", tmp_path / "run")
    kept = newest(path).arrays
    (path / "result.json").unlink()
    done = go_on(path, tmp_path / "registry", publish=True)
    assert str(done.version) == "push-ours@1"
    assert {name.removeprefix("evaluation/"): value for name, value in done.metrics.items()} == (
        RunDirectory(home / "runs" / "ours").read_result()["evaluation"]
    )
    assert all(np.array_equal(array, newest(path).arrays[name]) for name, array in kept.items())


def test_a_resume_may_say_what_began_the_run(home, tmp_path):
    """A job is started with the same words each time; the alias is of before, and the run keeps its version."""
    directory = RunDirectory(home / "runs" / "ours")
    said, saved = ["task=push", "method=ours", "primitives=panda-cube@champion"], directory.read_config()
    assert resumed_config(directory, said) == saved
    file = tmp_path / "push.yaml"
    file.write_text(json.dumps(small_trial().model_dump(mode="json", exclude_unset=True)))
    assert resumed_config(directory, [], file) == saved
    for other in ("primitives=panda-cube@99", "primitives=another@champion", "method=ours-her", "world.friction=0.5"):
        with pytest.raises(TandemError, match="a resumed run keeps its configuration"):
            resumed_config(directory, [other])


# --- what counts -----------------------------------------------------------------------------------------------------


def test_5_cm_are_counted_and_while_learning_a_centimetre_less_is_paid(champion, monkeypatch):
    counts, task = [], find_task("push")
    for distance in (0.05, 0.06):
        world = task.world_from(champion.config.world)
        options = {"num_episodes": 60, "num_steps": 50, "success_distance_m": distance, "seed": 2_000_007}
        counts.append(evaluate(IdlePolicy(), world, task.goals, **options).success_last)
    method = TaskLearning(small_trial(seed=7, run={"final_episodes": 60}).begin(BUNDLED, None), champion)
    monkeypatch.setattr(method, "player", IdlePolicy)
    assert method.measure()["evaluation/success_last"] == counts[0] < counts[1]
    worlds = method.loop.worlds
    following = np.zeros((3, 11), np.float32)
    following[:, 5:8] = [[0.0399, 0.0, 0.0], [0.0401, 0.0, 0.0], [0.0, 0.0, -0.0499]]
    rewards = worlds.rewards({"following": following}, np.zeros((3, 3), np.float32))
    np.testing.assert_array_equal(rewards, [1.0, 0.0, 0.0])
    worlds.close()


def test_goals_of_the_curve_of_the_end_and_of_learning_are_others(champion, monkeypatch):
    seeds, episodes = [], []
    monkeypatch.setattr(
        task_evaluation, "evaluate", lambda *given, **named: seeds.append(named["seed"]) or evaluate(*given, **named)
    )
    for seed in (3, 4):
        method = TaskLearning(small_trial(seed=seed).begin(BUNDLED, None), champion)
        method.evaluate()
        method.measure()
        episodes.append(method.loop.worlds.inputs()[:, 17:20])
        method.close()
    assert seeds == [1_000_003, 2_000_003, 1_000_004, 2_000_004]
    assert np.linalg.norm(episodes[0][:, None] - episodes[1][None], axis=2).min() > 1e-6


# --- loading and publishing ------------------------------------------------------------------------------------------


@pytest.fixture
def observation(champion):
    size = layouts(champion.config.world).bob.size
    return np.random.default_rng(0).uniform(-0.1, 0.2, (3, size)).astype(np.float32)


def acted(orchestrator, observation):
    """Actions of the first and the second step of episodes."""
    orchestrator.begin()
    return np.stack([orchestrator.act_deterministic(observation), orchestrator.act_deterministic(observation + 0.01)])


def refused(*arguments, **options):
    """The one line by which loading is refused."""
    with pytest.raises(TandemError) as refusal:
        service.load(*map(str, arguments), **options)
    assert_one_line(refusal.value)
    return str(refusal.value)


def test_it_acts_alike_from_its_directory_a_registry_and_a_service(home, champion, observation, tmp_path):
    run, registry = str(home / "runs" / "ours"), home / "registry"
    local = service.load(run, registry)
    expected = acted(local, observation)
    assert expected.shape == (2, 3, 4)
    assert (expected[0] != champion.policy.act_deterministic(observation)).any()
    assert (local.task.name, local.method, local.world.gripper) == ("push", "ours", "blocked")
    checkpoint = next((home / "runs" / "ours" / "checkpoints").iterdir())
    np.testing.assert_array_equal(acted(service.load(str(checkpoint), registry), observation), expected)

    manifest = Registry(registry).manifest("push-ours")
    result = RunDirectory(home / "runs" / "ours").read_result()
    assert manifest.metrics["evaluation/success_last"] == result["evaluation"]["success_last"]
    assert (manifest.spaces["kind"], manifest.spaces["primitives"]) == ("orchestrator", champion.manifest.reference)
    assert Registry(registry).verify(check=network_problems) == []
    for reference in (run, "push-ours@latest"):
        found = service.load(reference, registry)
        assert for_robot(found).world == found.nominal.world == local.world
        np.testing.assert_array_equal(acted(found, observation), expected)
    Registry(registry).export("push-ours", tmp_path / "exported")
    exported = service.load(str(tmp_path / "exported"), tmp_path / "no-registry")
    np.testing.assert_array_equal(acted(exported, observation), expected)

    with serve(home) as server, pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
        fetched = service.load("push-ours@latest", server.url)
        (listed,) = httpx.get(f"{server.url}/v1/primitives/push-ours").json()["versions"]
    assert (listed["kind"], listed["task"]) == ("orchestrator", "push")
    assert listed["primitives"] == champion.manifest.reference
    assert fetched.label == "push-ours@1"
    np.testing.assert_array_equal(acted(fetched, observation), expected)


def test_another_version_of_that_name_does_not_pass_for_its_primitives(home, champion, tmp_path):
    """A registry of one's own may have other primitives by the same reference: the digest decides."""
    own, number = Registry(tmp_path / "registry"), champion.manifest.version
    manifest, parameters = Registry(BUNDLED).load(str(champion.manifest.reference))
    fields = {name: getattr(manifest, name) for name in ("spaces", "normalisation", "config", "metrics")}
    for _ in range(number):
        parameters["gate.output.bias"] = parameters["gate.output.bias"] + np.float32(1.0)
        own.publish(manifest.name, parameters, **fields)
    run = home / "runs" / "ours"
    found = service.load(str(run), own.root)
    assert found.acts_with.label == f"{champion.manifest.reference} (bundled)"

    reason = refused(run, own.root, primitives=f"{manifest.name}@{number}")
    assert f"acts with {champion.manifest.reference} of digest" in reason
    assert f"{manifest.name}@{number} has other parameters" in reason
    assert "is not here: no 'nothing'" in refused(run, own.root, primitives="nothing@1")

    copy = shutil.copytree(run, tmp_path / "copy")
    before = files_in(copy)
    with pytest.raises(TandemError) as error:
        go_on(copy, own.root)
    assert_one_line(error.value, f"{manifest.name}@{number} has other parameters than the", "this run began with")
    after = files_in(copy)
    assert {name: after[name] for name in before if name not in ("log.jsonl", "status.json")} == {
        name: data for name, data in before.items() if name not in ("log.jsonl", "status.json")
    }


def test_orchestrators_and_primitives_are_not_taken_for_each_other(home, champion):
    registry, before = home / "registry", files_in(home / "registry")
    with pytest.raises(TandemError, match="@1 is a policy of the task push; tandem x needs primitives"):
        service.load("push-ours@latest", registry).expect("primitives", by="tandem x")
    for where, changes, said in (
        (registry, {"name": champion.manifest.name}, "panda-cube is the name of primitives already"),
        (registry, {"method": "scratch-monolithic"}, "the method scratch-monolithic acts with no primitives"),
        (registry, {"primitives": "/runs/cube"}, "an orchestrator for /runs/cube, which is no published version"),
        ("http://127.0.0.1:9", {}, "read only: publish in a directory"),
    ):
        config = small_trial(primitives_digest="0" * 64, **changes)
        if "method" in changes:
            config = small_trial(**changes)
        with pytest.raises(TandemError, match=said):
            train(config, RunDirectory(home / "new"), where, publish=True, on_iteration=ignore)
    assert files_in(registry) == before
    assert not (home / "new").exists()


def test_a_policy_from_nothing_needs_the_world_alone(home, champion, observation, tmp_path):
    found = service.load(str(home / "runs" / "scratch-monolithic"), tmp_path)
    assert found.acts_with is None
    assert acted(found, observation).shape == (2, 3, 4)
    for wrong, said in (
        (observation[:1], r"1 rows, and 3 in the step before: call begin\(\)"),
        (observation[0], r"1 rows, and 3 in the step before"),
        (observation[None], "shape"),
    ):
        with pytest.raises(TandemError, match=said):
            found.act_deterministic(wrong)
    found.begin()
    one = found.act_deterministic(observation[:1])
    found.begin()
    np.testing.assert_array_equal(found.act_deterministic(observation[0]), one[0])
    assert one.shape == (1, 4)
    assert "acts with nothing else" in refused(
        home / "runs" / "scratch-monolithic", tmp_path, primitives="panda-cube@champion"
    )


def test_a_manifest_that_lacks_what_an_orchestrator_needs(tmp_path):
    spaces = {"kind": "orchestrator", "method": "ours", "task": "push", "primitives": "panda-cube@1"}
    nothing = {"normalisation": {}, "config": {}, "metrics": {}}
    Registry(tmp_path).publish("old", {"gate.weight": np.zeros(1, dtype=np.float32)}, spaces=spaces, **nothing)
    assert refused("old@latest", tmp_path) == "old@1: its manifest lacks 'primitives_digest'; publish it again"


@pytest.mark.parametrize("name", ["/tmp/their/run", "their/run", "panda-cube@champion", "panda-cube"])
def test_what_a_published_policy_acts_with_is_a_version_and_no_path(tmp_path, name):
    """A directory could bring code, and an alias may be moved."""
    spaces = {"kind": "orchestrator", "method": "ours", "task": "push", "primitives": name}
    spaces |= {"primitives_digest": "0" * 64, "hold_steps": 1}
    nothing = {"normalisation": {}, "config": {}, "metrics": {}}
    Registry(tmp_path).publish("bad", {"weight": np.zeros(1, dtype=np.float32)}, spaces=spaces, **nothing)
    assert "which is no NAME@VERSION; publish it again" in refused("bad@latest", tmp_path)


def test_hindsight_fades_out_with_the_run(champion):
    """Of ours-her: 0.8 of the samples at first, none from half of the env steps on; here there are three iterations."""
    method = TaskLearning(small_trial("ours-her").begin("no registry here", None), champion)
    shares = []
    for _ in range(3):
        method.step()
        shares.append(method.loop.make_batch.share)
    method.close()
    assert shares == pytest.approx([0.8, 0.8 / 3, 0.0])


# --- bad input -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"task": "pushh"}, r"unknown task 'pushh'.*push"),
        ({"method": "ourss"}, r"method = 'ourss': choose one of .*ours-her.*; did you mean 'ours"),
        (
            {"run": {"total_env_steps": 200}},
            "run.total_env_steps = 200 has to be more than sac.learning_starts, ",
        ),
        (
            {"method": "ours-her", "sac": {"learning_starts": 199}},
            "sac.learning_starts = 199: goals are relabelled from whole episodes, so give at least 200, one of",
        ),
        ({"world": {"friction": 0.5}}, "a task is learned in the world of its primitives; leave out world"),
        ({"primitives": "nothing@1"}, "nothing"),
        ({"method": "lsd"}, r"this method acts by skills, and panda-cube@.* has none: name some"),
        ({"reward_margin_m": 0.05}, "reward_margin_m = 0.05"),
    ],
)
def test_settings_that_are_wrong(tmp_path, changes, said):
    with pytest.raises(TandemError, match=said) as error:
        begin(tmp_path / "run", small_trial(**changes), tmp_path / "registry")
    assert_one_line(error.value)
    assert not (tmp_path / "run").exists()


def test_there_is_no_beginning_from_another_policy(champion):
    with pytest.raises(TandemError, match="name primitives by --set primitives=NAME"):
        small_trial().begin(BUNDLED, champion)


def test_the_methods_of_the_table_that_learn_are_those_of_configurations():
    assert {name for name, row in TASK_METHODS.items() if row.learns} == {
        name for name, place in KNOWN.items() if place.endswith(TaskConfig.__name__)
    }
