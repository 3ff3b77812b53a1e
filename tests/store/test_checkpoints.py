"""A run continues from exactly what was saved, whatever happens to the files."""

import errno
import json
import logging
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from service.base import tensors
from service.base.errors import CheckpointError, FormatVersionError
from service.store import checkpoints
from service.store.checkpoints import CheckpointStore, read_checkpoint


@pytest.fixture
def store(tmp_path: Path) -> CheckpointStore:
    """An empty store that keeps two."""
    return CheckpointStore(tmp_path / "checkpoints", keep=2)


def save(store: CheckpointStore, step: int) -> Path:
    """A checkpoint whose content tells its step."""
    return store.save(step, {"weight": np.full(5, step, np.float32)}, {"step_twice": 2 * step})


def flip_bit(path: Path, position: int) -> None:
    """Change one bit of a file."""
    data = bytearray(path.read_bytes())
    data[position] ^= 1
    path.write_bytes(data)


def test_arrays_and_meta_come_back_exactly(store: CheckpointStore) -> None:
    random_state = np.random.default_rng(7).bit_generator.state  # 128-bit integers
    arrays = {
        "qpos": np.random.default_rng(0).normal(size=(3, 4)).T,
        "state": np.array([2**64 - 1], dtype=np.uint64),
        "done": np.array([True, False]),
        "time": np.array(0.1 + 0.2),
    }
    meta = {"rng": random_state, "loss": float("nan"), "best": float("-inf"), "third": 1 / 3, "name": 'a"\u00e4'}
    store.save(12, arrays, meta)
    step, loaded, loaded_meta = store.load_latest()
    assert step == 12
    assert set(loaded) == set(arrays)
    for name, array in arrays.items():
        assert loaded[name].dtype == array.dtype
        assert loaded[name].shape == array.shape
        assert loaded[name].tobytes() == array.tobytes()
    assert json.dumps(loaded_meta, sort_keys=True) == json.dumps(meta, sort_keys=True)
    continued = np.random.default_rng()
    continued.bit_generator.state = loaded_meta["rng"]
    assert continued.random() == np.random.default_rng(7).random()


def test_file_name_and_pruning(store: CheckpointStore) -> None:
    for step in (20, 40, 60, 80):
        save(store, step)
    assert store.steps() == [60, 80]
    assert sorted(path.name for path in store.directory.iterdir()) == [
        "checkpoint-00000060.safetensors",
        "checkpoint-00000080.safetensors",
    ]
    assert store.load_latest().meta == {"step_twice": 160}
    (link := store.directory / "best").symlink_to(store.path(60))
    assert read_checkpoint(link).step == 60


def test_any_flipped_bit_is_found(store: CheckpointStore) -> None:
    path = save(store, 1)
    good = path.read_bytes()
    positions, refused = range(0, len(good), 3), 0
    for position in positions:
        flip_bit(path, position)
        try:
            checkpoint = read_checkpoint(path)
        except (CheckpointError, FormatVersionError):
            refused += 1
        else:  # padding of the header: the content is untouched
            assert checkpoint.step == 1
            assert checkpoint.meta == {"step_twice": 2}
            assert checkpoint.arrays["weight"].tolist() == [1.0] * 5
        path.write_bytes(good)
    assert refused >= len(positions) - 3


def test_any_truncation_is_found(store: CheckpointStore) -> None:
    path = save(store, 1)
    good = path.read_bytes()
    for length in range(0, len(good), 7):
        path.write_bytes(good[:length])
        with pytest.raises(CheckpointError, match="damaged"):
            read_checkpoint(path)


def test_a_damaged_newest_falls_back_with_a_warning(store: CheckpointStore, caplog: pytest.LogCaptureFixture) -> None:
    save(store, 20)
    flip_bit(save(store, 40), -1)
    with caplog.at_level(logging.WARNING):
        assert store.load_latest().step == 20
    (record,) = caplog.records
    assert "checkpoint-00000040.safetensors is damaged" in record.getMessage()
    assert "continuing from checkpoint-00000020.safetensors" in record.getMessage()


def test_a_damaged_newer_file_never_crowds_out_a_good_one(tmp_path: Path) -> None:
    store = CheckpointStore(tmp_path, keep=1)
    save(store, 20)
    damaged = store.path(40)
    damaged.write_bytes(b"half")
    assert store.load_latest().step == 20
    save(store, 30)
    assert store.load_latest().step == 30
    save(store, 50)
    assert store.steps() == [50]


def test_a_damaged_file_of_an_earlier_process_never_crowds_out_a_good_one(tmp_path: Path) -> None:
    before = CheckpointStore(tmp_path, keep=3, epoch=1)
    for step in (5, 10, 15):
        save(before, step)
    flip_bit(before.path(15), -1)
    store = CheckpointStore(tmp_path, keep=2, epoch=2)
    assert store.load_latest().step == 10
    save(store, 12)
    assert store.steps() == [10, 15, 12]
    save(store, 14)
    assert store.steps() == [12, 14]


def test_a_directory_that_cannot_be_read_for_a_moment_ends_no_run(
    store: CheckpointStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    save(store, 20)

    def fails(path: Path) -> None:
        raise OSError(errno.ESTALE, "stale")

    with monkeypatch.context() as patch:
        patch.setattr(Path, "iterdir", fails)
        save(store, 40)
    assert store.steps() == [20, 40]


def test_no_checkpoint_and_none_usable(store: CheckpointStore) -> None:
    with pytest.raises(CheckpointError, match=r"no checkpoint in .*checkpoints; .*without --resume"):
        store.load_latest()
    flip_bit(save(store, 1), -1)
    save(store, 2).write_bytes(tensors.encode({"a": np.zeros(2)}))  # a safetensors file of another program
    with pytest.raises(CheckpointError, match=r"no usable checkpoint .*00000002.*damaged.*00000001.*damaged"):
        store.load_latest()


def test_another_format_version_is_named(store: CheckpointStore, monkeypatch: pytest.MonkeyPatch) -> None:
    save(store, 20)
    with monkeypatch.context() as patch:
        patch.setattr(checkpoints, "FORMAT_VERSION", 2)
        path = save(store, 40)
    with pytest.raises(FormatVersionError, match="format version 2 found, this tandem reads 1"):
        store.load_latest()
    assert path.exists()


@pytest.mark.parametrize("call", ["write", "fsync"])
def test_a_full_disk_leaves_earlier_checkpoints_alone(
    store: CheckpointStore, full_disk: Callable[[str], None], call: str
) -> None:
    for step in (20, 40):
        save(store, step)
    before = {path: path.read_bytes() for path in store.directory.iterdir()}
    full_disk(call)
    with pytest.raises(
        CheckpointError, match=r"cannot write .*00000060.*: No space left on device \([0-9]+ bytes free"
    ):
        save(store, 60)
    assert {path: path.read_bytes() for path in store.directory.iterdir()} == before
    assert store.load_latest().step == 40


_WRITER = """
import sys
from pathlib import Path
import numpy as np
from service.store.checkpoints import CheckpointStore
store = CheckpointStore(Path(sys.argv[1]), keep=2)
step = store.load_latest().step if store.steps() else 0
while True:
    step += 1
    store.save(step, {"weight": np.full(100_000, step)}, {})
    print(step, flush=True)
"""


def test_kill_9_at_any_moment_leaves_a_whole_checkpoint(store: CheckpointStore) -> None:
    command = [sys.executable, "-c", _WRITER, str(store.directory)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        reported = [int(process.stdout.readline()) for _ in range(2)]
        process.kill()
    assert 2 <= len(store.steps()) <= 3
    step, arrays, _ = store.load_latest()
    assert step == store.steps()[-1] >= reported[-1]
    assert (arrays["weight"] == step).all()


def test_what_a_killed_writer_left_is_ignored_and_removed(store: CheckpointStore) -> None:
    store.directory.mkdir()
    leftover = store.directory / ".tmp-123-abc"
    leftover.write_bytes(b"half")
    assert store.steps() == []
    save(store, 40)
    assert not leftover.exists()


@pytest.mark.parametrize(
    ("arrays", "meta"), [({"text": np.array(["a"])}, {}), ({}, {"array": np.zeros(2)}), ({}, {1: "a", "1": "b"})]
)
def test_what_cannot_be_saved_exactly_is_refused(store: CheckpointStore, arrays: dict, meta: dict) -> None:
    with pytest.raises((TypeError, ValueError)):
        store.save(1, arrays, meta)
    assert store.steps() == []


# --- several processes -----------------------------------------------------------------------------------------------


def test_what_a_stale_process_saves_is_not_read_and_deletes_nothing(tmp_path: Path) -> None:
    """It is 30 steps further, as it did not notice that another one went on from its step 20."""
    first, second = (CheckpointStore(tmp_path, keep=1, epoch=number) for number in (1, 10**8))
    first.save(20, {}, {})
    second.save(30, {}, {})
    first.save(60, {}, {})
    assert CheckpointStore(tmp_path, keep=1).load_latest().step == 30
    second.save(40, {}, {})
    assert [path.name for path in tmp_path.iterdir()] == ["checkpoint-e100000000-00000040.safetensors"]


def test_checkpoints_without_a_number_are_the_oldest(tmp_path: Path) -> None:
    CheckpointStore(tmp_path, keep=1).save(50, {}, {})
    CheckpointStore(tmp_path, keep=2, epoch=1).save(20, {}, {})
    assert CheckpointStore(tmp_path, keep=1).load_latest().step == 20
