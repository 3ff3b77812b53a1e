"""The number of each process that ever ran a run: claimed once, and only the highest counts."""

import pytest

from service.base import epoch
from service.base.errors import RunTakenError, StorageError
from service.base.jsonl import JsonlWriter, read_jsonl
from service.base.lock import claim_epoch, newest_epoch
from service.store.checkpoints import CheckpointStore
from service.store.run_directory import RunDirectory
from tests.runs.runs import assert_one_line, play, tiny_config


def test_each_number_is_claimed_once(tmp_path, monkeypatch):
    """Another process takes the number that this one has just seen to be free."""

    def look(directory):
        monkeypatch.undo()
        seen = newest_epoch(directory)
        assert claim_epoch(directory) == 1
        return seen

    monkeypatch.setattr(epoch, "newest_epoch", look)
    assert claim_epoch(tmp_path) == 2
    assert (newest_epoch(tmp_path), claim_epoch(tmp_path)) == (2, 3)


def test_a_number_beyond_eight_digits(tmp_path):
    """It once made a run that was resumed hang for ever."""
    (tmp_path / "epochs").mkdir()
    (tmp_path / "epochs" / "99999999").touch()
    number = claim_epoch(tmp_path)
    assert (number, claim_epoch(tmp_path)) == (10**8, 10**8 + 1)
    CheckpointStore(tmp_path, keep=1, epoch=number).save(20, {}, {})
    CheckpointStore(tmp_path, keep=1).save(30, {}, {})
    assert CheckpointStore(tmp_path, keep=1).load_latest().step == 20
    (tmp_path / "epochs" / ("9" * 255)).touch()
    with pytest.raises(StorageError) as error:
        claim_epoch(tmp_path)
    assert_one_line(error.value, tmp_path, "File name too long")


def test_only_the_highest_may_write(tmp_path):
    play(tmp_path / "cube", tiny_config(total_env_steps=200))
    first = RunDirectory(tmp_path / "cube")
    first.claim(resume=True)
    first.check_owner()
    claim_epoch(tmp_path / "cube")  # as another machine may where its file system has no locks
    with pytest.raises(RunTakenError) as error:
        first.check_owner()
    assert_one_line(error.value, tmp_path, "taken over by another process", "stops")
    first.close()


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
    fresh.cut_after(1)
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
