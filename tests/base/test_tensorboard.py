"""TensorBoard's events, read back by TensorBoard's own reader."""

import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from service.base import tensorboard as events
from service.base.tensorboard import EventFile
from tests.runs.runs import no_room_above


def shown(directory, tag="loss"):
    """(step, value) as TensorBoard shows them."""
    accumulator = EventAccumulator(str(directory))
    accumulator.Reload()
    return [(event.step, event.value) for event in accumulator.Scalars(tag)]


def add(file, *steps, offset=0.0):
    for step in steps:
        file.add({"iteration": step, "env_steps": step, "loss": step + offset})


def test_an_event_is_there_as_soon_as_it_is_written(tmp_path):
    file = EventFile(tmp_path)
    add(file, 1, 2)
    assert shown(tmp_path) == [(1, 1.0), (2, 2.0)]
    accumulator = EventAccumulator(str(tmp_path))
    accumulator.Reload()
    assert accumulator.Tags()["scalars"] == ["loss"]  # iteration and env steps are the axis


def test_what_is_made_again_is_shown_once_and_as_it_is_now(tmp_path):
    add(EventFile(tmp_path), 1, 2, 3, 4)
    add(EventFile(tmp_path, after_step=2), 3, offset=0.5)
    assert shown(tmp_path) == [(1, 1.0), (2, 2.0), (3, 3.5)]
    add(EventFile(tmp_path, after_step=0), 1, offset=0.25)
    assert shown(tmp_path) == [(1, 1.25)]


def test_files_are_read_in_the_order_they_were_written_whatever_the_clock_says(tmp_path, monkeypatch):
    for now, step in ((5000.0, 1), (5000.0, 2), (4000.0, 3)):
        monkeypatch.setattr(events.time, "time", lambda now=now: now)
        add(EventFile(tmp_path, after_step=step - 1), step)
    names = sorted(path.name for path in tmp_path.iterdir())
    assert [name.split(".")[3] for name in names] == ["0000005000", "0000005001", "0000005002"]
    assert shown(tmp_path) == [(1, 1.0), (2, 2.0), (3, 3.0)]


def test_a_full_disk_leaves_whole_events(tmp_path):
    file = EventFile(tmp_path)
    add(file, 1)
    (path,) = tmp_path.iterdir()
    with no_room_above(path.stat().st_size + 20), pytest.raises(ValueError, match="cannot write"):
        add(file, 2)
    assert shown(tmp_path) == [(1, 1.0)]
    add(file, 3)
    assert [step for step, _ in shown(tmp_path)] == [1, 2, 3]
