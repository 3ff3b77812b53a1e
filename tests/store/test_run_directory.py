"""A run directory: what is written when, what is refused, and what a resume cuts away."""

import numpy as np
import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.backend.event_processing.event_file_loader import EventFileLoader

from service.base.errors import CheckpointError, ConfigError, RunTakenError, StorageError, TandemError
from service.base.lock import claim_epoch
from service.config import load_config
from service.store import run_directory
from service.store.checkpoints import CheckpointStore
from service.store.run_directory import Published, Resumption, RunDirectory
from service.store.run_writer import RunWriter
from tests.runs.runs import assert_one_line, no_permission, no_room_above, read_lines, tiny_config


@pytest.fixture
def directory(tmp_path):
    """A run that has begun."""
    directory = RunDirectory(tmp_path / "run")
    directory.start(tiny_config())
    yield directory
    directory.close()


def record(directory, *iterations):
    for iteration in iterations:
        directory.record({"iteration": iteration, "env_steps": 100 * iteration, "bob/success_rate": iteration / 8})


def resumption(iteration):
    return Resumption(iteration, 100 * iteration, "0" * 32, {})


def read_events(path):
    """(step, {tag: value}) of every TensorBoard event with a summary, in the order of the files' names."""
    events = [event for file in sorted(path.iterdir()) for event in EventFileLoader(str(file)).Load()]
    values = [(event.step, {v.tag: v.tensor.float_val[0] for v in event.summary.value}) for event in events]
    return [(step, value) for step, value in values if value]


# --- beginning a run -------------------------------------------------------------------------------------------------


def test_a_started_run_holds_its_resolved_configuration(directory):
    assert directory.exists
    assert directory.read_config() == tiny_config()
    assert load_config(directory.path / "config.yaml") == tiny_config()
    assert (directory.path / "checkpoints").is_dir()


def test_a_second_run_is_refused(directory):
    with pytest.raises(TandemError) as error:
        RunDirectory(directory.path).claim(resume=False)
    assert_one_line(error.value, directory.path, "--resume", "--run-dir")


def test_a_directory_of_something_else_is_refused(tmp_path):
    for name in (".git", "tandem-error-1.txt", "log.txt", "log.jsonl", "status.json"):
        (tmp_path / name).touch()
    directory = RunDirectory(tmp_path)
    directory.claim(resume=False)
    directory.close()
    (tmp_path / "notes.md").touch()
    with pytest.raises(TandemError) as error:
        directory.claim(resume=False)
    assert_one_line(error.value, tmp_path, "holds no run, but 'notes.md'", "another --run-dir")
    (tmp_path / ".lock").touch()  # of a run that was killed while it began
    directory.claim(resume=False)
    directory.close()


def test_nothing_is_left_of_a_run_that_did_not_begin(tmp_path):
    directory = RunDirectory(tmp_path / "run")
    directory.claim(resume=False)
    assert directory.epoch == 1
    directory.close()
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(CheckpointError):
        directory.claim(resume=True)


def test_only_the_process_of_the_highest_epoch_may_write(tmp_path):
    directory = RunDirectory(tmp_path / "run")
    directory.claim(resume=False)
    directory.check_owner()
    claim_epoch(tmp_path / "run")  # as another machine may where its file system has no locks
    with pytest.raises(RunTakenError) as error:
        directory.check_owner()
    assert_one_line(error.value, tmp_path, "taken over by another process", "stops")
    directory.close()


def test_no_run_there_or_one_with_a_damaged_configuration(directory, tmp_path):
    directory.config_file.write_text("game: {num_worlds: many}\n")
    for each, said in ((RunDirectory(tmp_path / "none"), "config.yaml"), (directory, "game.num_worlds")):
        with pytest.raises(ConfigError) as error:
            each.read_config()
        assert_one_line(error.value, each.path, said)


def test_notes_are_read_back_and_damaged_ones_named(directory):
    assert (directory.read_published(), directory.read_result()) == (None, None)
    directory.write_published(Published("cube@3", "0" * 64))
    directory.write_result({"evaluation": {"success": 0.5}, "env_steps": 7, "wall_s": 1.5})
    assert directory.read_published() == ("cube@3", "0" * 64)
    result = directory.read_result()
    assert (result["evaluation"], result["env_steps"], result["made"].keys()) == (
        {"success": 0.5}, 7, {"git_commit", "learning_version", "num_cores"}
    )  # fmt: skip
    for name, read in (("published.json", directory.read_published), ("result.json", directory.read_result)):
        (directory.path / name).write_text('{"version": 1}')
        with pytest.raises(StorageError) as error:
            read()
        assert_one_line(error.value, directory.path / name)


@pytest.mark.parametrize("name", ["", "tensorboard"])
def test_a_directory_that_cannot_be_made_is_one_line(tmp_path, name):
    path = tmp_path / "run"
    if name:
        path.mkdir()
    (path / name if name else path).write_text("a file where a directory should be")
    with pytest.raises(TandemError) as error:
        RunDirectory(path).start(tiny_config())
    assert_one_line(error.value, "cannot write", path)
    assert not RunDirectory(path).exists  # once that is mended, the same command works


# --- records ---------------------------------------------------------------------------------------------------------


def test_metrics_are_a_line_and_an_event_each(directory):
    record(directory, 1, 2)
    directory.record({"iteration": 3, "env_steps": 300, "bob/success_rate": 0.5, "time/wall_s": 2.0})
    directory.close()
    assert [row["iteration"] for row in read_lines(directory.metrics_file)] == [1, 2, 3]
    assert read_lines(directory.metrics_file)[2] == {
        "iteration": 3, "env_steps": 300, "bob/success_rate": 0.5, "time/wall_s": 2.0
    }  # fmt: skip
    assert read_events(directory.path / "tensorboard") == [
        (100, {"bob/success_rate": 0.125}),
        (200, {"bob/success_rate": 0.25}),
        (300, {"bob/success_rate": 0.5, "time/wall_s": 2.0}),
    ]


def test_a_resume_cuts_both_files_and_goes_on(directory):
    record(directory, 1, 2, 3)
    for iteration in (1, 2, 3):
        directory.record_goals(iteration, 100 * iteration, np.zeros((1, 7)))
    directory.close()
    resumed = RunDirectory(directory.path)
    resumed.start(tiny_config(total_env_steps=900), resumption(1))
    record(resumed, 2)
    resumed.close()
    assert [row["iteration"] for row in read_lines(resumed.metrics_file)] == [1, 2]
    assert [row["iteration"] for row in read_lines(resumed.goals_file)] == [1]
    assert resumed.read_config().run.total_env_steps == 900
    assert [step for step, _ in read_events(resumed.path / "tensorboard")] == [100, 200, 300, 200]
    accumulator = EventAccumulator(str(resumed.path / "tensorboard")).Reload()  # as TensorBoard shows them
    assert [event.step for event in accumulator.Scalars("bob/success_rate")] == [100, 200]


def test_goals_are_start_goal_and_result(directory):
    directory.record_goals(7, 1234, np.array([[0.00001, 0.001, 0.002, 0.1, 0.101, 0.10204, 1.0], [0.3] * 6 + [0.0]]))
    directory.record_goals(8, 2345, np.empty((0, 7)))
    assert read_lines(directory.goals_file) == [
        {"iteration": 7, "env_steps": 1234, "goals": [[0.0, 0.001, 0.002, 0.1, 0.101, 0.102, 1.0], [0.3] * 6 + [0.0]]},
        {"iteration": 8, "env_steps": 2345, "goals": []},
    ]


def test_broken_worlds_are_kept_but_not_without_end(directory, monkeypatch, caplog):
    monkeypatch.setattr(run_directory, "MAX_DIVERGED_FILES", 3)
    diverged = ((np.arange(4.0), np.zeros(4, dtype=np.float32)), (np.arange(4.0) + 1, np.ones(4, dtype=np.float32)))
    directory.dump_diverged("000000", ())
    assert not (directory.path / "broken").exists()
    for sequence in range(5):
        directory.dump_diverged(f"{sequence:06d}", diverged)
    files = sorted((directory.path / "broken").iterdir())
    assert len(files) == sum("physics diverged" in message for message in caplog.messages) == 3
    with np.load(files[0]) as dump:
        assert dump["states"].tolist() == [[0.0, 1.0, 2.0, 3.0], [1.0, 2.0, 3.0, 4.0]]
        assert dump["actions"].tolist() == [[0.0] * 4, [1.0] * 4]


# --- a full disk -----------------------------------------------------------------------------------------------------


def test_records_wait_for_room_and_then_come_in_their_order(directory, caplog):
    record(directory, 1)
    with no_room_above(directory.metrics_file.stat().st_size + 10):
        record(directory, 2, 3)
    assert [row["iteration"] for row in read_lines(directory.metrics_file)] == [1]
    record(directory, 4)
    assert [row["iteration"] for row in read_lines(directory.metrics_file)] == [1, 2, 3, 4]
    assert [step for step, _ in read_events(directory.path / "tensorboard")] == [100, 200, 300, 400]
    metrics, events = caplog.messages  # said once each, although two records did not fit
    assert_one_line(metrics, "cannot write", directory.metrics_file, "File too large", "the run goes on")
    assert_one_line(events, "cannot write", "tensorboard", "the run goes on")
    assert directory.problems() == []
    with no_room_above(0):
        record(directory, 5)
        assert_one_line(directory.problems()[0], "cannot write", directory.metrics_file)
    assert sum("metrics.jsonl" in message for message in caplog.messages) == 2  # said again
    directory.close()  # now there is room
    assert [row["iteration"] for row in read_lines(directory.metrics_file)] == [1, 2, 3, 4, 5]


def test_goals_and_broken_worlds_on_a_full_disk_do_not_end_a_run(directory, caplog):
    with no_room_above(0):
        directory.record_goals(1, 100, np.zeros((1, 7)))
        directory.dump_diverged("000000", ((np.arange(4.0), np.zeros(4)),))
    directory.record_goals(2, 200, np.zeros((1, 7)))
    assert [row["iteration"] for row in read_lines(directory.goals_file)] == [1, 2]
    assert list((directory.path / "broken").iterdir()) == []
    assert "round-000000.npz: File too large" in caplog.text


def test_closing_on_a_full_disk_does_not_hide_why_the_run_ended(directory, caplog):
    """``pretrain`` closes in a ``finally``: an error there would replace the one line about the checkpoint."""
    with no_room_above(0):
        record(directory, 1)
        caplog.clear()
        directory.close()
    assert_one_line(caplog.messages[0], "lost", directory.metrics_file)
    resumed = RunDirectory(directory.path)
    resumed.start(tiny_config(), resumption(0))
    record(resumed, 2)
    resumed.close()
    assert [row["iteration"] for row in read_lines(directory.metrics_file)] == [2]


def test_a_directory_that_may_not_be_read_for_a_while_ends_no_run(directory, caplog):
    """``Path.exists`` and its like raise there, before Python 3.14."""
    record(directory, 1)
    writer = RunWriter(directory)
    with no_permission(directory.path):
        record(directory, 2)
        directory.dump_diverged("000000", ((np.arange(4.0), np.zeros(4)),))
        directory.sync()
        assert not writer.stop_requested()
    assert "Permission denied" in caplog.text
    record(directory, 3)
    assert [row["iteration"] for row in read_lines(directory.metrics_file)] == [1, 2, 3]
    claimed = RunDirectory(directory.path.parent / "claimed")
    claimed.claim(resume=False)
    claimed.start(tiny_config())
    with no_permission(claimed.path):
        assert CheckpointStore(claimed.checkpoints, keep=1).steps() == []
        claimed.close()
    assert claimed.exists
