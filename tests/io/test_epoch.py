"""The number of each process that ever ran a run: claimed once, and only the highest counts."""

from concurrent.futures import ThreadPoolExecutor

import pytest

from service.io.checkpoints import CheckpointStore
from service.io.epoch import Epoch, newest_epoch
from service.io.errors import RunTakenError, StorageError
from service.io.jsonl import JsonlWriter, read_jsonl
from tests.runtime.runs import assert_one_line


def test_each_number_is_claimed_once(tmp_path):
    with ThreadPoolExecutor(8) as pool:
        numbers = list(pool.map(lambda _: Epoch(tmp_path).number, range(40)))
    assert len(set(numbers)) == 40
    assert newest_epoch(tmp_path) == max(numbers)
    assert Epoch(tmp_path).number == max(numbers) + 1
    assert len(list((tmp_path / "epochs").iterdir())) == 10


def test_a_number_beyond_eight_digits(tmp_path):
    """It once made a run that was resumed hang for ever."""
    (tmp_path / "epochs").mkdir()
    (tmp_path / "epochs" / "99999999").touch()
    epoch = Epoch(tmp_path)
    assert (epoch.number, Epoch(tmp_path).number) == (10**8, 10**8 + 1)
    CheckpointStore(tmp_path, keep=1, epoch=epoch.number).save(20, {}, {})
    CheckpointStore(tmp_path, keep=1).save(30, {}, {})
    assert CheckpointStore(tmp_path, keep=1).load_latest().step == 20
    (tmp_path / "epochs" / ("9" * 255)).touch()
    with pytest.raises(StorageError) as error:
        Epoch(tmp_path)
    assert_one_line(error.value, tmp_path, "File name too long")


def test_only_the_highest_may_write(tmp_path):
    first = Epoch(tmp_path)
    first.check()
    second = Epoch(tmp_path)
    second.check()
    with pytest.raises(RunTakenError) as error:
        first.check()
    assert_one_line(error.value, tmp_path, "taken over by another process", "stops")


def test_what_a_stale_process_saves_is_not_read_and_deletes_nothing(tmp_path):
    """It is 30 steps further, as it did not notice that another one went on from its step 20."""
    first, second = (CheckpointStore(tmp_path, keep=1, epoch=number) for number in (1, 2))
    first.save(20, {}, {})
    second.save(30, {}, {})
    first.save(60, {}, {})
    assert CheckpointStore(tmp_path, keep=1).load_latest().step == 30
    second.save(40, {}, {})
    assert [path.name for path in tmp_path.iterdir()] == ["checkpoint-e00000002-00000040.safetensors"]


def test_checkpoints_without_a_number_are_the_oldest(tmp_path):
    CheckpointStore(tmp_path, keep=1).save(50, {}, {})
    CheckpointStore(tmp_path, keep=2, epoch=1).save(20, {}, {})
    assert CheckpointStore(tmp_path, keep=1).load_latest().step == 20


def test_what_a_stale_process_records_is_not_read(tmp_path):
    path = tmp_path / "metrics.jsonl"
    stale = JsonlWriter(path)
    stale.append({"iteration": 1})
    stale.append({"iteration": 2})
    fresh = JsonlWriter(path)
    fresh.truncate_after(1)
    fresh.append({"iteration": 2, "by": "fresh"})
    with pytest.raises(StorageError, match="another process has put a file of its own in its place"):
        stale.append({"iteration": 3})
    fresh.append({"iteration": 3, "by": "fresh"})
    assert [row.get("by") for row in read_jsonl(path)] == [None, "fresh", "fresh"]


def test_a_file_that_somebody_removed_begins_anew(tmp_path):
    path = tmp_path / "metrics.jsonl"
    writer = JsonlWriter(path)
    writer.append({"iteration": 1})
    path.unlink()
    writer.append({"iteration": 2})
    assert read_jsonl(path) == [{"iteration": 2}]
