"""A whole pre-training: how it ends by itself and by a signal, and what it publishes."""

import os
import re
import signal
import time

import numpy as np
import pytest

from service.actors import evaluation
from service.base.errors import ConfigError, TandemError
from service.config import parse_config
from service.envs.sampling import draw_goals
from service.registry.bundled import BUNDLED
from service.registry.registry import Registry
from service.runs import train as module
from service.runs.resuming import resumed_config
from service.runs.signals import InterruptError
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
    """The final evaluation of a few episodes, and no pictures."""
    monkeypatch.setattr(module, "make_artifacts", lambda directory, registry: {"curves": directory.path / "curves.png"})


def run_pretrain(tmp_path, config=None, *, on_iteration=lambda metrics: None, **kwargs):
    directory = RunDirectory(tmp_path / "run")
    return train(
        config or tiny_config(total_env_steps=400),
        directory,
        tmp_path / "registry",
        on_iteration=on_iteration,
        **kwargs,
    )


# --- to the end ------------------------------------------------------------------------------------------------------


def test_a_finished_run_is_evaluated_drawn_and_published(tmp_path, quick):
    done = run_pretrain(tmp_path)
    assert done.result.reason == "finished"
    assert done.files == {"curves": tmp_path / "run" / "curves.png"}
    assert str(done.version) == "tiny@1"
    kinds = [f"evaluation/{kind}_success_{when}" for kind in ("table", "air", "mixed") for when in ("last", "ever")]
    assert sorted(done.metrics) == sorted(kinds)
    assert all(0.0 <= rate <= 1.0 for rate in done.metrics.values())
    assert {"play", "checkpoint"} <= {line.split()[0] for line in done.timing.splitlines()}


def test_the_final_evaluation_is_played_on_goals_of_its_own(tmp_path, quick, monkeypatch):
    """Or the choice of a run by its learning curve would be a choice by the same episodes that then measure it."""
    drawn = []

    def watched(kind, *args, **kwargs):
        drawn.append((kind, draw_goals(kind, *args, **kwargs)))
        return drawn[-1][1]

    monkeypatch.setattr(evaluation, "draw_goals", watched)
    curve, final = [], []
    for name in ("one", "another"):
        config = tiny_config(total_env_steps=400, evaluation_interval=1)
        done = train(config, RunDirectory(tmp_path / name), tmp_path / "registry", on_iteration=lambda metrics: None)
        assert done.result.iteration == (len(drawn) - 3) / 3 >= 2
        curve += [drawn[start : start + 3] for start in range(0, len(drawn) - 3, 3)]
        final.append(drawn[-3:])
        drawn.clear()
    for evaluations in (curve, final):
        for goals in evaluations:
            assert [kind for kind, _ in goals] == ["table", "air", "mixed"]
            assert all(np.array_equal(one, first) for (_, one), (_, first) in zip(goals, evaluations[0], strict=True))
    for (_, one), (_, other) in zip(curve[0], final[0], strict=True):
        assert one.shape == other.shape == (4, 3)
        assert not np.isin(one[:, :2], other[:, :2]).any()


def test_what_is_published_is_bob_and_all_that_a_user_of_him_needs(tmp_path, quick):
    done = run_pretrain(tmp_path)
    manifest, parameters = Registry(tmp_path / "registry").load("tiny@latest")
    saved = {name.removeprefix("bob/"): a for name, a in newest(tmp_path / "run").arrays.items() if name[:4] == "bob/"}
    assert parameters.keys() == saved.keys()
    assert all(np.array_equal(parameters[name], array) for name, array in saved.items())
    assert parse_config(manifest.config, where="a test") == tiny_config(total_env_steps=400)
    assert manifest.metrics == done.metrics | {"env_steps": done.result.num_env_steps}
    assert manifest.spaces["action"] == 4
    assert manifest.spaces["observation"] == 14
    assert len(manifest.normalisation["offset"]) == len(manifest.normalisation["scale"]) == 14


def test_publishing_can_be_left_to_a_resume(tmp_path, quick):
    done = run_pretrain(tmp_path, publish=False)
    assert (done.result.reason, done.version) == ("finished", None)
    assert done.metrics != {}
    assert not (tmp_path / "registry").exists()
    assert str(run_pretrain(tmp_path, resume=True).version) == "tiny@1"


def test_a_finished_run_that_goes_on_publishes_another_version(tmp_path, quick):
    first = run_pretrain(tmp_path)
    config = resumed_config(RunDirectory(tmp_path / "run"), ["run.total_env_steps=600"])
    second = run_pretrain(tmp_path, config, resume=True)
    assert (str(first.version), str(second.version)) == ("tiny@1", "tiny@2")
    assert second.result.num_env_steps >= 600
    registry = Registry(tmp_path / "registry")
    assert [registry.manifest(f"tiny@{number}").parent for number in (1, 2)] == [None, "tiny@1"]


def test_a_finished_run_with_nothing_left_to_do_publishes_nothing(tmp_path, quick):
    first = run_pretrain(tmp_path)
    again = run_pretrain(tmp_path, resumed_config(RunDirectory(tmp_path / "run"), []), resume=True)
    assert first.version == again.version
    assert [str(version) for version in Registry(tmp_path / "registry").versions("tiny")] == ["tiny@1"]


def test_a_damaged_version_is_mended_by_resuming_its_run(tmp_path, quick):
    run_pretrain(tmp_path)
    registry = Registry(tmp_path / "registry")
    next((registry.root / "blobs" / "sha256").iterdir()).write_bytes(b"")
    assert len(registry.verify()) == 1
    run_pretrain(tmp_path, resumed_config(RunDirectory(tmp_path / "run"), []), resume=True)
    assert registry.verify() == []


def test_a_version_has_the_parent_its_run_published_before_also_after_an_interruption(tmp_path, quick):
    run_pretrain(tmp_path)
    config = resumed_config(RunDirectory(tmp_path / "run"), ["run.total_env_steps=1500"])
    interrupted = run_pretrain(
        tmp_path, config, on_iteration=lambda _: os.kill(os.getpid(), signal.SIGINT), resume=True
    )
    assert interrupted.result.reason == "interrupted"
    # nobody's parent, though the newest of the name
    Registry(tmp_path / "registry").publish(
        "tiny", {"a": np.zeros(1)}, spaces={}, normalisation={}, config={}, metrics={}
    )
    last = run_pretrain(tmp_path, config, resume=True)
    assert str(last.version) == "tiny@3"
    assert Registry(tmp_path / "registry").manifest("tiny@3").parent == "tiny@1"


def test_a_version_of_the_same_number_in_another_registry_is_no_parent(tmp_path, quick):
    run_pretrain(tmp_path)
    other = Registry(tmp_path / "other")
    other.publish("tiny", {"a": np.zeros(1)}, spaces={}, normalisation={}, config={}, metrics={})
    config = resumed_config(RunDirectory(tmp_path / "run"), ["run.total_env_steps=600"])
    train(config, RunDirectory(tmp_path / "run"), other.root, resume=True, on_iteration=lambda metrics: None)
    assert other.manifest("tiny@2").parent is None


def test_a_registry_that_is_only_read_is_refused_before_anything_is_learned(tmp_path):
    with pytest.raises(TandemError) as error:
        train(tiny_config(), RunDirectory(tmp_path / "run"), BUNDLED, on_iteration=lambda metrics: None)
    assert_one_line(error.value, "cannot write", BUNDLED, "only read")
    assert not (tmp_path / "run").exists()


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
    done = run_pretrain(tmp_path, resumed_config(RunDirectory(tmp_path / "run"), []), resume=True)
    assert str(done.version) == "tiny@1"


# --- signals ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_the_run_after_the_iteration(tmp_path, quick, number):
    before = signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)

    def interrupt(metrics):
        if metrics["iteration"] == 2:
            os.kill(os.getpid(), number)

    done = run_pretrain(tmp_path, on_iteration=interrupt)
    assert (done.result.reason, done.result.iteration) == ("interrupted", 2)
    assert (done.version, done.files, done.metrics, done.signal) == (None, {}, {}, number)
    assert newest(tmp_path / "run").step == 2
    assert not (tmp_path / "registry").exists()
    assert (signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)) == before


def test_a_second_signal_ends_it_at_once(tmp_path, quick):
    def interrupt_twice(metrics):
        if metrics["iteration"] == 2:
            os.kill(os.getpid(), signal.SIGINT)
            os.kill(os.getpid(), signal.SIGINT)

    with pytest.raises(InterruptError, match="SIGINT"):
        run_pretrain(tmp_path, on_iteration=interrupt_twice)
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


@pytest.mark.parametrize(("number", "exit_code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_saves_and_says_how_to_resume(tmp_path, number, exit_code):
    """A real process, a real signal; the run it leaves goes on as if nothing had happened."""
    process, path = start_endless_run(tmp_path)
    deadline_s = time.monotonic() + 600.0
    while process.poll() is None and time.monotonic() < deadline_s:
        if (path / "metrics.jsonl").exists() and len((path / "metrics.jsonl").read_bytes().splitlines()) >= 3:
            process.send_signal(number)
            break
        time.sleep(0.02)
    try:
        out, err = process.communicate(timeout=600)
    finally:
        process.kill()
    assert process.returncode == exit_code, err
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


def test_a_resumed_run_keeps_its_configuration(begun):
    assert resumed_config(begun, []) == tiny_config(seed=3)
    changed = resumed_config(begun, ["run.total_env_steps=9e5", "run.keep_checkpoints=7"])
    assert changed == tiny_config(seed=3, total_env_steps=900_000, keep_checkpoints=7)


@pytest.mark.parametrize("override", ["seed=4", "game.num_worlds=3", "runs.total_env_steps=3", "name=run.x"])
def test_only_the_run_part_may_change(begun, override):
    with pytest.raises(ConfigError) as error:
        resumed_config(begun, ["run.keep_checkpoints=7", override])
    assert_one_line(error.value, override, "run.*")


@pytest.mark.parametrize(
    ("override", "part"), [("run.total=3", "run.total"), ("run.total_env_steps=0", "run.total_env_steps")]
)
def test_a_bad_value_is_found_before_anything_is_loaded(begun, override, part):
    with pytest.raises(ConfigError) as error:
        resumed_config(begun, [override])
    assert_one_line(error.value, part)


@pytest.fixture
def file(tmp_path):
    """Writes a YAML file that says what ``begun`` was begun with, and this under ``run`` and at the top."""

    def write(run=None, **top):
        return write_yaml(tmp_path / "given.yaml", TREE | {"seed": 3} | top | {"run": TREE["run"] | (run or {})})

    return write


def test_a_file_may_say_again_what_the_run_has(begun, file):
    assert resumed_config(begun, [], file()) == tiny_config(seed=3)


def test_what_a_file_says_under_run_comes_before_the_overrides(begun, file):
    given = file({"total_env_steps": 700, "keep_checkpoints": 5})
    changed = resumed_config(begun, ["run.keep_checkpoints=7"], given)
    assert changed == tiny_config(seed=3, total_env_steps=700, keep_checkpoints=7)


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
    assert_one_line(error.value, given, *parts)


def test_nothing_to_resume(tmp_path):
    with pytest.raises(ConfigError) as error:
        resumed_config(RunDirectory(tmp_path / "none"), [])
    assert_one_line(error.value, "no run in", tmp_path / "none")


def test_the_tree_is_what_the_processes_run(tmp_path):
    from service.config import load_config

    assert load_config(write_yaml(tmp_path / "tiny.yaml", TREE)) == tiny_config()
