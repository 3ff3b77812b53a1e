"""What a resume checks before it goes on: the records, the run, the configuration."""

import json
import shutil

import pytest
import yaml

from service.base.errors import CheckpointError, ConfigError, StorageError, TandemError
from service.base.lock import claim_epoch
from service.config import load_config
from service.registry.registry import Registry
from service.runs import train as training
from service.runs.resuming import changed_settings, resumed_config
from service.runs.train import open_run
from service.store.run_directory import RunDirectory
from service.store.run_history import read_history
from tests.runs.runs import assert_one_line, newest, play, read_lines, tiny_config


@pytest.fixture(scope="module")
def begun(tmp_path_factory):
    """A run that ended at its budget, with the records of some iterations."""
    path = tmp_path_factory.mktemp("runs") / "begun"
    _, result = play(path, tiny_config(total_env_steps=600))
    assert result.iteration >= 3
    return path


@pytest.fixture
def run(begun, tmp_path):
    return shutil.copytree(begun, tmp_path / "cube")


def go_on(path, *, steps=800):
    directory = RunDirectory(path)
    config = resumed_config(directory, [f"run.total_env_steps={steps}"])
    local = open_run(config, directory, resume=True)
    try:
        return local.run()
    finally:
        local.close()
        directory.close()


def leave_out_a_line(path):
    lines = path.read_bytes().splitlines(keepends=True)
    path.write_bytes(b"".join(lines[:1] + lines[2:]))


@pytest.mark.usefixtures("no_artifacts")
def test_what_is_lost_of_the_records_is_named_and_noted_once(run, tmp_path, monkeypatch, caplog):
    last = newest(run).step
    leave_out_a_line(run / "metrics.jsonl")
    with (run / "goals.jsonl").open("ab") as file:
        file.write(b"\x00{]\n")
    go_on(run, steps=600)  # nothing is left to do
    said = ("metrics.jsonl: iterations that it lacks: 1", "goals.jsonl: lines that were no records: 1")
    told = [message for message in caplog.messages if "goes on without" in message]
    assert told == [f"{run}: {each}; the run goes on without them" for each in said]
    (event,) = read_history(run).events
    assert (event.after_iteration, event.damaged_records) == (last, said)
    assert [row["iteration"] for row in read_lines(run / "metrics.jsonl")] == [1, *range(3, newest(run).step + 1)]
    directory, registry = RunDirectory(run), tmp_path / "registry"
    config = resumed_config(directory, ["run.total_env_steps=700"])
    training.train(config, directory, registry, resume=True, on_iteration=lambda metrics: None)
    manifest = Registry(registry).manifest("tiny@1")
    first, second = manifest.history["events"]
    assert first["damaged_records"] == list(said)
    assert second["changed"] == {"run.total_env_steps": [600, 700]}
    assert (second["damaged_records"], manifest.history["run"]) == ([], read_history(run).run)


def test_a_task_is_no_name_of_a_run_of_self_play(run):
    with pytest.raises(ConfigError) as error:
        resumed_config(RunDirectory(run), ["task=wall", "method=ours"])
    assert_one_line(error.value, "the run learns by self-play, not by ours")


def test_a_file_is_no_run_directory(run, caplog):
    directory = RunDirectory(run / "metrics.jsonl")
    with pytest.raises(TandemError) as error:
        directory.claim(resume=False)
    directory.close()
    assert_one_line(error.value, "metrics.jsonl is no directory; name another --run-dir")
    assert caplog.messages == []  # nothing was lost


def test_a_checkpoint_of_another_run_is_refused(run, tmp_path):
    play(tmp_path / "other", tiny_config(total_env_steps=600))
    shutil.rmtree(run / "checkpoints")
    shutil.copytree(tmp_path / "other" / "checkpoints", run / "checkpoints")
    with pytest.raises(CheckpointError) as error:
        go_on(run)
    ours, theirs = read_history(run).run, read_history(tmp_path / "other").run
    assert_one_line(error.value, run, "of another run", f"({theirs[:8]}, not {ours[:8]})", "put that of this run back")


def test_a_checkpoint_of_another_seed_is_refused(run):
    tree = yaml.safe_load((run / "config.yaml").read_text())
    (run / "config.yaml").write_text(yaml.safe_dump(tree | {"seed": 3}))
    with pytest.raises(CheckpointError) as error:
        go_on(run)
    assert_one_line(error.value, run, "seed is 3 in config.yaml", "was made with 0", "put that back")


def test_a_key_of_a_checkpoint_that_is_gone_is_named(run):
    config = load_config(run / "config.yaml")
    saved = config.model_dump(mode="json") | {"gone": 5}
    with pytest.raises(CheckpointError) as error:
        changed_settings(saved, config, run)
    assert_one_line(error.value, run, "gone is None in config.yaml", "was made with 5")


def test_a_configuration_that_may_change_is_said_and_noted(run, caplog):
    caplog.set_level("INFO")
    tree = yaml.safe_load((run / "config.yaml").read_text())
    tree["learner"]["bob"]["learning_rate"] = 1e-5
    (run / "config.yaml").write_text(yaml.safe_dump(tree))
    go_on(run)
    (said,) = [each for each in caplog.messages if "changed since iteration" in each]
    assert "learner.bob.learning_rate from 0.0003 to 1e-05" in said
    (event,) = read_history(run).events
    assert event.changed["learner.bob.learning_rate"] == (0.0003, 1e-5)
    assert event.changed["run.total_env_steps"] == (600, 800)


@pytest.mark.parametrize(("version", "reader"), [("0.1.0", "0.2"), ("0.2.0", "0.2"), ("0.4.1", "0.4.1")])
def test_a_run_of_another_version_is_left_alone(run, version, reader):
    identity = json.loads((run / "run.json").read_text()) | {"tandem": version}
    if version == "0.2.0":
        del identity["tandem"]
    (run / "run.json").write_text(json.dumps(identity))
    if version == "0.1.0":
        (run / "run.json").unlink()
    before = {path: path.read_bytes() for path in run.rglob("*") if path.is_file()}
    with pytest.raises(ConfigError) as error:
        resumed_config(RunDirectory(run), [])
    assert str(error.value) == (
        f"{run} is of another version of tandem, which this one does not read: use tandem {reader}"
    )
    assert {path: path.read_bytes() for path in run.rglob("*") if path.is_file()} == before


def test_a_damaged_history_is_one_line(run):
    (run / "run.json").write_text(json.dumps({"run": "x"}))
    with pytest.raises(StorageError) as error:
        go_on(run)
    assert_one_line(error.value, run / "run.json", "damaged", "restore it from a copy")


def test_a_process_that_was_overtaken_saves_nothing(run):
    """Another one has claimed the run, on a file system without locks."""
    directory = RunDirectory(run)
    local = open_run(resumed_config(directory, ["run.total_env_steps=900"]), directory, resume=True)
    before = sorted(path.name for path in (run / "checkpoints").iterdir())
    claim_epoch(run)
    with pytest.raises(StorageError, match="taken over by another process"):
        local.run()
    local.close()
    directory.close()
    assert sorted(path.name for path in (run / "checkpoints").iterdir()) == before
