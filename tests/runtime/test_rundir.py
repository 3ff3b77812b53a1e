"""A run directory: what is written when, what is refused, and what a resume cuts away."""

import errno
import os
from types import SimpleNamespace

import numpy as np
import pytest

from service.config import ConfigError, load_config
from service.errors import TandemError
from service.generator.validity import Verdict
from service.runtime.rundir import GOALS_PER_ITERATION, MAX_BROKEN_FILES, RunDirectory
from tests.runtime.runs import assert_one_line, read_lines, tiny_config


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


def read_events(path):
    """(step, {tag: value}) of every TensorBoard event with a summary, in the order of the files' names."""
    from tensorboard.backend.event_processing.event_file_loader import EventFileLoader

    events = [event for file in sorted(path.iterdir()) for event in EventFileLoader(str(file)).Load()]
    values = [(event.step, {v.tag: v.tensor.float_val[0] for v in event.summary.value}) for event in events]
    return [(step, value) for step, value in values if value]


# --- beginning a run -------------------------------------------------------------------------------------------------


def test_nothing_is_made_before_the_start(tmp_path):
    directory = RunDirectory(tmp_path / "run")
    assert not directory.exists
    assert list(tmp_path.iterdir()) == []


def test_a_started_run_holds_its_resolved_configuration(directory):
    assert directory.exists
    assert directory.read_config() == tiny_config()
    assert load_config(directory.path / "config.yaml") == tiny_config()
    assert (directory.path / "checkpoints").is_dir()


def test_a_second_run_is_refused(directory):
    with pytest.raises(TandemError) as error:
        RunDirectory(directory.path).start(tiny_config(seed=3))
    assert_one_line(error.value, directory.path, "--resume", "--run-dir")
    assert directory.read_config() == tiny_config()


def test_no_run_there(tmp_path):
    with pytest.raises(ConfigError) as error:
        RunDirectory(tmp_path / "none").read_config()
    assert_one_line(error.value, tmp_path / "none", "config.yaml")


def test_a_damaged_configuration_is_named(directory):
    directory.config_file.write_text("game: {num_worlds: many}\n")
    with pytest.raises(ConfigError) as error:
        directory.read_config()
    assert_one_line(error.value, directory.config_file, "game.num_worlds", "many")


@pytest.mark.parametrize("name", ["", "checkpoints", "tensorboard"])
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
    for iteration in range(3):
        directory.record_goals(iteration, 100 * iteration, make_records(1))
    directory.close()
    resumed = RunDirectory(directory.path)
    resumed.start(tiny_config(total_env_steps=900), after_iteration=1)
    record(resumed, 2)
    resumed.close()
    assert [row["iteration"] for row in read_lines(resumed.metrics_file)] == [1, 2]
    assert [row["iteration"] for row in read_lines(resumed.goals_file)] == [1]
    assert resumed.read_config().run.total_env_steps == 900
    assert [step for step, _ in read_events(resumed.path / "tensorboard")][-1] == 200


def test_close_twice(directory):
    directory.close()
    directory.close()


def make_records(num, **overrides):
    """What ``record_goals`` reads of N solved, valid, own goals."""
    positions = np.arange(3 * num, dtype=float).reshape(num, 3) / 1000 + 1e-5
    fields = {
        "start_position": positions,
        "goal": positions + 0.1,
        "solved": np.ones(num, dtype=bool),
        "verdict": np.full(num, Verdict.VALID),
        "played": np.ones(num, dtype=bool),
        "replayed": np.zeros(num, dtype=bool),
        "bob_past": np.zeros(num, dtype=bool),
    }
    return SimpleNamespace(**fields | {name: np.array(value) for name, value in overrides.items()})


def test_goals_are_start_goal_and_result(directory):
    directory.record_goals(6, 1234, make_records(2, solved=[True, False]))
    (row,) = read_lines(directory.goals_file)
    assert (row["iteration"], row["env_steps"]) == (7, 1234)
    assert row["goals"] == [
        [0.0, 0.001, 0.002, 0.1, 0.101, 0.102, 1.0],
        [0.003, 0.004, 0.005, 0.103, 0.104, 0.105, 0.0],
    ]


def test_only_goals_the_current_bob_played_himself(directory):
    records = make_records(
        5,
        verdict=[Verdict.VALID, Verdict.OUTSIDE, Verdict.VALID, Verdict.VALID, Verdict.VALID],
        played=[True, False, True, True, False],
        replayed=[False, False, True, False, False],
        bob_past=[False, False, False, True, False],
    )
    directory.record_goals(0, 0, records)
    (row,) = read_lines(directory.goals_file)
    assert [goal[0] for goal in row["goals"]] == [0.0]


def test_no_goals_and_very_many(directory):
    directory.record_goals(0, 0, make_records(0))
    directory.record_goals(1, 0, make_records(100))
    assert [len(row["goals"]) for row in read_lines(directory.goals_file)] == [0, GOALS_PER_ITERATION]


def test_broken_worlds_are_kept_but_not_without_end(directory):
    broken = ((np.arange(4.0), np.zeros(4, dtype=np.float32)), (np.arange(4.0) + 1, np.ones(4, dtype=np.float32)))
    directory.dump_broken(SimpleNamespace(sequence=0, broken=()))
    assert not (directory.path / "broken").exists()
    for sequence in range(MAX_BROKEN_FILES + 5):
        directory.dump_broken(SimpleNamespace(sequence=sequence, broken=broken))
    files = sorted((directory.path / "broken").iterdir())
    assert len(files) == MAX_BROKEN_FILES
    with np.load(files[0]) as dump:
        assert dump["states"].tolist() == [[0.0, 1.0, 2.0, 3.0], [1.0, 2.0, 3.0, 4.0]]
        assert dump["actions"].tolist() == [[0.0] * 4, [1.0] * 4]


# --- a full disk -----------------------------------------------------------------------------------------------------


def no_space(*_):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_a_full_disk_under_tensorboard_is_one_line(directory, monkeypatch):
    monkeypatch.setattr(directory._events, "add_event", no_space)
    with pytest.raises(TandemError) as error:
        record(directory, 1)
    assert_one_line(error.value, "cannot write", "tensorboard", "No space left")
    assert len(read_lines(directory.metrics_file)) == 1


def test_closing_on_a_full_disk_does_not_hide_why_the_run_ended(directory, monkeypatch):
    """``pretrain`` closes in a ``finally``: an error there would replace the one line about the checkpoint."""
    with monkeypatch.context() as patch:
        patch.setattr(directory._events, "close", no_space)
        directory.close()
