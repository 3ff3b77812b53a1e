"""A whole pre-training: how it ends by itself and by a signal, and what it publishes."""

import os
import re
import shutil
import signal
import time

import numpy as np
import pytest

import service
from service.base.errors import ConfigError, TandemError
from service.config import load_config, parse_config
from service.envs import rules
from service.envs.sampling import draw_goals
from service.methods.method import StateLostError
from service.methods.self_play import LocalSelfPlay
from service.registry.registry import Registry
from service.runs import train as module
from service.runs.resuming import resumed_config
from service.runs.train import UnfinishedError, train
from service.store.run_directory import RunDirectory
from tests.runs.runs import (
    TREE,
    assert_one_line,
    assert_same_run,
    newest,
    no_room_above,
    play,
    read_lines,
    start_endless_run,
    tiny_config,
    write_yaml,
)

pytestmark = pytest.mark.usefixtures("default_signals")


@pytest.fixture
def quick(monkeypatch):
    """No pictures."""
    monkeypatch.setattr(module, "make_artifacts", lambda directory, registry: {"curves": directory.path / "curves.png"})


def run_pretrain(home, config=None, *, on_iteration=lambda metrics: None, registry="registry", **kwargs):
    config, directory = config or tiny_config(total_env_steps=400), RunDirectory(home / "run")
    return train(config, directory, home / registry, on_iteration=on_iteration, **kwargs)


@pytest.fixture(scope="module")
def published(tmp_path_factory):
    """A run to its end that was published, and what that said."""
    home = tmp_path_factory.mktemp("published")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "make_artifacts", lambda directory, registry: {"curves": directory.path / "curves.png"})
        return home, run_pretrain(home)


@pytest.fixture
def home(published, tmp_path, quick):
    """A copy of it."""
    return shutil.copytree(published[0], tmp_path / "home")


def goes_on(home, steps=None, **kwargs):
    overrides = [f"run.total_env_steps={steps}"] if steps is not None else []
    return run_pretrain(home, resumed_config(RunDirectory(home / "run"), overrides), resume=True, **kwargs)


def test_a_run_goes_back_to_its_checkpoint_as_often_as_its_state_is_lost_also_as_it_starts_again(
    tmp_path, quick, monkeypatch, caplog
):
    monkeypatch.setattr(module, "BACK_OFF_S", 0.0)
    start, left = LocalSelfPlay.start, ["while it learns", "while it starts"]

    def lose(what):
        if left and left[0] == what:
            del left[0]
            raise StateLostError(f"lost {what}")

    def start_or_lose(self, state=None):
        if state is not None:
            lose("while it starts")
        start(self, state)

    monkeypatch.setattr(LocalSelfPlay, "start", start_or_lose)
    done = run_pretrain(tmp_path, on_iteration=lambda metrics: lose("while it learns"))
    assert (done.reason, left) == ("finished", [])
    said = [message.partition(";")[0] for message in caplog.messages if message.startswith("lost")]
    assert said == ["lost while it learns", "lost while it starts"]


# --- to the end ------------------------------------------------------------------------------------------------------


def test_a_finished_run_is_evaluated_drawn_and_published_with_all_that_a_user_needs(published):
    home, done = published
    assert done.reason == "finished"
    assert done.files == {"curves": home / "run" / "curves.png"}
    kinds = [f"evaluation/{kind}_success_{when}" for kind in ("table", "air", "mixed") for when in ("last", "ever")]
    assert sorted(done.metrics) == sorted(kinds)
    assert all(0.0 <= rate <= 1.0 for rate in done.metrics.values())
    assert {"play", "checkpoint"} <= {line.split()[0] for line in done.timing.splitlines()}
    manifest, parameters = Registry(home / "registry").load("tiny@latest")
    saved = {name.removeprefix("bob/"): a for name, a in newest(home / "run").arrays.items() if name[:4] == "bob/"}
    assert parameters.keys() == saved.keys()
    assert all(np.array_equal(parameters[name], array) for name, array in saved.items())
    assert parse_config(manifest.config, where="a test") == tiny_config(total_env_steps=400)
    assert manifest.metrics == done.metrics | {"env_steps": done.num_env_steps}
    assert (str(done.version), manifest.spaces["action"], manifest.spaces["observation"]) == ("tiny@1", 4, 14)
    assert len(manifest.normalisation["offset"]) == len(manifest.normalisation["scale"]) == 14


def test_the_final_evaluation_is_played_on_goals_of_its_own(tmp_path, quick, monkeypatch):
    """Or the choice of a run by its learning curve would be a choice by the same episodes that then measure it."""
    drawn = []

    def watched(kind, *args, **kwargs):
        drawn.append((kind, draw_goals(kind, *args, **kwargs)))
        return drawn[-1][1]

    monkeypatch.setattr(rules, "draw_goals", watched)
    done = run_pretrain(tmp_path, tiny_config(total_env_steps=400, evaluation_interval=1))
    *curve, final = (drawn[start : start + 3] for start in range(0, len(drawn), 3))
    assert len(curve) == done.iteration >= 2
    for goals in (*curve, final):
        assert [kind for kind, _ in goals] == ["table", "air", "mixed"]
    for goals in curve:
        assert all(np.array_equal(one, first) for (_, one), (_, first) in zip(goals, curve[0], strict=True))
    for (_, one), (_, other) in zip(curve[0], final, strict=True):
        assert one.shape == other.shape == (4, 3)
        assert not np.isin(one[:, :2], other[:, :2]).any()


def test_publishing_can_be_left_to_a_resume(tmp_path, quick):
    done = run_pretrain(tmp_path, publish=False)
    assert (done.reason, done.version) == ("finished", None)
    assert done.metrics != {}
    assert not (tmp_path / "registry").exists()
    assert str(run_pretrain(tmp_path, resume=True).version) == "tiny@1"


def test_a_finished_run_that_goes_on_publishes_another_version(home):
    done = goes_on(home, 600)
    assert str(done.version) == "tiny@2"
    assert done.num_env_steps >= 600
    registry = Registry(home / "registry")
    assert [registry.manifest(f"tiny@{number}").parent for number in (1, 2)] == [None, "tiny@1"]


def test_a_program_finds_runs_and_registry_where_commands_do(tmp_path, monkeypatch):
    asked = []
    monkeypatch.setattr(module, "train", lambda _, directory, registry, **__: asked.append((directory.path, registry)))
    monkeypatch.setenv("TANDEM_RUNS", str(tmp_path / "runs"))
    monkeypatch.setenv("TANDEM_REGISTRY", str(tmp_path / "registry"))
    service.train("panda-cube-lsd")
    assert asked == [(tmp_path / "runs" / "panda-cube-lsd", str(tmp_path / "registry"))]


@pytest.mark.usefixtures("quick")
def test_a_bob_without_primitives_is_not_published(tmp_path):
    config = parse_config(TREE | {"policy": TREE["policy"] | {"monolithic_bob": {"hidden_sizes": [8]}}}, where="a test")
    with pytest.raises(TandemError, match=r"a Bob without primitives .* cannot be published"):
        run_pretrain(tmp_path, config, publish=True)
    assert list(tmp_path.iterdir()) == []


def test_a_finished_run_with_nothing_left_to_do_publishes_nothing_and_mends_what_is_damaged(home):
    registry = Registry(home / "registry")
    assert str(goes_on(home).version) == "tiny@1"
    assert [str(version) for version in registry.versions("tiny")] == ["tiny@1"]
    next((registry.root / "blobs" / "sha256").iterdir()).write_bytes(b"")
    assert len(registry.verify()) == 1
    goes_on(home)
    assert registry.verify() == []


def test_a_version_has_the_parent_its_run_published_before_also_after_an_interruption(home):
    interrupted = goes_on(home, 1500, on_iteration=lambda _: os.kill(os.getpid(), signal.SIGINT))
    assert interrupted.reason == "interrupted"
    # the parent of none, though the newest of the name
    Registry(home / "registry").publish("tiny", {"a": np.zeros(1)}, spaces={}, normalisation={}, config={}, metrics={})
    assert str(goes_on(home, 1500).version) == "tiny@3"
    assert Registry(home / "registry").manifest("tiny@3").parent == "tiny@1"


def test_a_version_of_the_same_number_in_another_registry_is_no_parent(home):
    other = Registry(home / "other")
    other.publish("tiny", {"a": np.zeros(1)}, spaces={}, normalisation={}, config={}, metrics={})
    goes_on(home, 600, registry="other")
    assert other.manifest("tiny@2").parent is None


def test_a_registry_on_a_full_disk_costs_no_learning(tmp_path, quick, monkeypatch):
    publish = module.publish_run

    def publish_without_room(*args):
        with no_room_above(1_000):
            return publish(*args)

    with monkeypatch.context() as patch:
        patch.setattr(module, "publish_run", publish_without_room)
        with pytest.raises(UnfinishedError) as error:
            run_pretrain(tmp_path)
    assert_one_line(error.value, "saved, but not published", "cannot write", tmp_path / "registry", "--resume")
    assert error.value.exit_code == 1
    assert str(goes_on(tmp_path).version) == "tiny@1"


# --- signals ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_the_run_after_the_iteration(tmp_path, quick, number):
    before = signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)

    def interrupt(metrics):
        if metrics["iteration"] == 2:
            os.kill(os.getpid(), number)

    done = run_pretrain(tmp_path, on_iteration=interrupt)
    assert (done.reason, done.iteration) == ("interrupted", 2)
    assert (done.version, done.files, done.metrics, done.signal) == (None, {}, {}, number)
    assert newest(tmp_path / "run").step == 2
    assert not (tmp_path / "registry").exists()
    assert (signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)) == before


def test_a_signal_saves_and_says_how_to_resume(tmp_path):
    """A real process, a real signal; the run it leaves goes on as if nothing had happened."""
    process, path = start_endless_run(tmp_path)
    deadline_s = time.monotonic() + 600.0
    while process.poll() is None and time.monotonic() < deadline_s:
        if (path / "metrics.jsonl").exists() and len((path / "metrics.jsonl").read_bytes().splitlines()) >= 3:
            process.send_signal(signal.SIGTERM)
            break
        time.sleep(0.02)
    try:
        out, err = process.communicate(timeout=600)
    finally:
        process.kill()
    assert process.returncode == 128 + signal.SIGTERM, err
    assert re.search(r"^interrupted after [\d,]+ env steps, \d+ iterations$", out, re.MULTILINE)
    assert f"tandem train --resume --run-dir {path}" in out
    assert "Traceback" not in err
    saved = newest(path)
    assert saved.step == read_lines(path / "metrics.jsonl")[-1]["iteration"]
    total = saved.meta["env_steps"] + 300
    play(path, resumed_config(RunDirectory(path), [f"run.total_env_steps={total}"]), resume=True)
    play(tmp_path / "whole", tiny_config(total_env_steps=total))
    assert_same_run(path, tmp_path / "whole")


# --- the configuration of a resumed run ------------------------------------------------------------------------------


@pytest.fixture
def begun(tmp_path):
    directory = RunDirectory(tmp_path)
    directory.start(tiny_config(seed=3))
    directory.close()
    return directory


def test_a_file_that_says_no_name_says_again_what_a_run_was_begun_with(begun, tmp_path):
    file = write_yaml(tmp_path / "another.yaml", {key: value for key, value in TREE.items() if key != "name"})
    assert load_config(file).name == "another"
    assert load_config(file, ["name=mine"]).name == "mine"
    assert resumed_config(begun, ["seed=3"], file) == tiny_config(seed=3)


def test_a_resumed_run_keeps_its_configuration(begun):
    assert resumed_config(begun, []) == tiny_config(seed=3)
    changed = resumed_config(begun, ["run.total_env_steps=9e5", "run.keep_checkpoints=7"])
    assert changed == tiny_config(seed=3, total_env_steps=900_000, keep_checkpoints=7)


@pytest.mark.parametrize(
    ("override", "parts"),
    [
        ("seed=4", ["seed = 4, but the run has 3", "only run.* and learner.alice.learning_rate and "]),
        ("game.num_worlds=3", ["game.num_worlds = 3", "has 24"]),
        ("name=run.x", ["name = 'run.x'"]),
        ("learner.bob.learning_rates=1", ["unknown key 'learner.bob.learning_rates'"]),
        ("runs.total_env_steps=3", ["unknown key 'runs'"]),
        ("run.total=3", ["run.total"]),
        ("run.total_env_steps=0", ["run.total_env_steps"]),
    ],
)
def test_only_the_run_part_may_change_and_a_bad_value_is_found(begun, override, parts):
    with pytest.raises(ConfigError) as error:
        resumed_config(begun, ["run.keep_checkpoints=7", override])
    assert_one_line(error.value, *parts)


@pytest.fixture
def file(tmp_path):
    """Writes a YAML file that says what ``begun`` was begun with, and this under ``run`` and at the top."""

    def write(run=None, **top):
        return write_yaml(tmp_path / "given.yaml", TREE | {"seed": 3} | top | {"run": TREE["run"] | (run or {})})

    return write


def test_a_file_may_say_again_what_the_run_has_and_change_what_may_change(begun, file):
    assert resumed_config(begun, [], file()) == tiny_config(seed=3)
    given = file({"total_env_steps": 700, "keep_checkpoints": 5})
    changed = resumed_config(begun, ["run.keep_checkpoints=7"], given)
    assert changed == tiny_config(seed=3, total_env_steps=700, keep_checkpoints=7)
    learner = {**TREE["learner"], "bob": {**TREE["learner"]["bob"], "learning_rate": 1e-6}}
    assert resumed_config(begun, [], file(learner=learner)).learner.bob.learning_rate == 1e-6


def test_what_a_file_leaves_out_under_run_stays_as_saved(tmp_path):
    directory = RunDirectory(tmp_path)
    directory.start(tiny_config(keep_checkpoints=9))
    directory.close()
    given = write_yaml(tmp_path / "given.yaml", TREE | {"run": {"total_env_steps": 700}})
    assert resumed_config(directory, [], given) == tiny_config(keep_checkpoints=9, total_env_steps=700)


@pytest.mark.parametrize(
    ("top", "parts"),
    [
        ({"seed": 4}, ["seed = 4", "has 3"]),
        ({"game": TREE["game"] | {"num_worlds": 8}}, ["game.num_worlds = 8", "has 24"]),
        ({"policy": TREE["policy"] | {"monolithic_bob": {"hidden_sizes": [8]}}}, ["policy.monolithic_bob."]),
        ({"games": {}}, ["unknown key 'games'"]),
    ],
)
def test_a_file_that_says_otherwise_is_refused(begun, file, top, parts):
    given = file(**top)
    with pytest.raises(ConfigError) as error:
        resumed_config(begun, [], given)
    assert_one_line(error.value, *parts)


def test_nothing_to_resume(tmp_path):
    with pytest.raises(ConfigError) as error:
        resumed_config(RunDirectory(tmp_path / "none"), [])
    assert_one_line(error.value, "no run in", tmp_path / "none")
