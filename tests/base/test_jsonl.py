import tracemalloc

import numpy as np
import pytest

from service.base.errors import StorageError, TandemError
from service.base.jsonl import JsonlWriter, read_jsonl
from tests.runs.runs import assert_one_line


@pytest.fixture
def path(tmp_path):
    return tmp_path / "run" / "metrics.jsonl"


def _write(path, text):
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(text)


def test_what_is_appended_is_read_back_in_order(path):
    goals = np.array([[0.5, np.nan]])
    JsonlWriter(path).append({"iteration": 0, "alice/valid_fraction": 0.25})
    JsonlWriter(path).append({"iteration": np.int64(3), "a": np.float32(0.5), "b": float("inf"), "goals": goals})
    assert path.read_text().splitlines(True) == [
        '{"iteration": 0, "alice/valid_fraction": 0.25}\n',
        '{"iteration": 3, "a": 0.5, "b": null, "goals": [[0.5, null]]}\n',
    ]
    assert read_jsonl(path)[0] == {"iteration": 0, "alice/valid_fraction": 0.25}
    assert len(read_jsonl(path)) == 2


@pytest.mark.parametrize(
    ("last", "num"), [(b"", 2), (b'{"iteration": 2}', 3), (b'{"iteration": 2, "x', 2), (b'{"a": "\xc3', 2)]
)
def test_a_torn_last_line_is_passed_over(path, last, num):
    _write(path, b'{"iteration": 0}\n{"iteration": 1}\n' + last)
    assert [record["iteration"] for record in read_jsonl(path)] == list(range(num))


@pytest.mark.parametrize("line", [b"{", b"[1]", b"", b"\xff"])
def test_a_damaged_line_before_the_last_is_named(path, line):
    _write(path, b'{"iteration": 0}\n' + line + b'\n{"iteration": 2}\n')
    with pytest.raises(TandemError, match=r"metrics\.jsonl line 2"):
        read_jsonl(path)


def test_a_file_that_cannot_be_used_is_one_line_for_the_user(path):
    with pytest.raises(TandemError) as error:
        read_jsonl(path)
    assert_one_line(error.value, "cannot read", path)
    path.parent.write_text("a file where a directory should be")
    with pytest.raises(TandemError) as error:
        JsonlWriter(path).append({"iteration": 0})
    assert_one_line(error.value, "cannot write", path)


def test_a_cut_keeps_the_bytes_of_records_in_their_order(path):
    writer = JsonlWriter(path)
    assert writer.cut_after(5) == (0, 0)
    assert not path.exists()
    _write(path, b'{"iteration":   1, "x": 1e0}\n{"iteration": 2}\n{"iterat')
    assert writer.cut_after(1) == (1, 0)
    assert path.read_bytes() == b'{"iteration":   1, "x": 1e0}\n'
    strange = b'[1]\n\xff\n{}\n{"iteration": "1"}\n{"iteration": null}\n{"iteration": 0}\n'
    _write(path, b'{"iteration": 1}\n' + strange + b'{"iteration": 3}\n{"iteration": 4}\n')
    assert writer.cut_after(3) == (2, 6)
    assert path.read_bytes() == b'{"iteration": 1}\n{"iteration": 3}\n'


def test_a_cut_holds_a_line_at_a_time(path):
    """A run of a million iterations has records of gigabytes."""
    _write(path, b"".join(b'{"iteration": %d, "x": "%s"}\n' % (number, b"." * 10_000) for number in range(400)))
    tracemalloc.start()
    try:
        assert JsonlWriter(path).cut_after(199) == (200, 0)
        _, most = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert path.stat().st_size > 2_000_000 > 4 * most
    assert [record["iteration"] for record in read_jsonl(path)] == list(range(200))


def test_a_cut_that_does_not_fit_or_cannot_be_read_changes_nothing(path, full_disk):
    _write(path, b'{"iteration": 1}\n{"iteration": 2}\n')
    full_disk("write")
    with pytest.raises(StorageError) as error:
        JsonlWriter(path).cut_after(1)
    assert_one_line(error.value, "cannot write", path)
    assert [record["iteration"] for record in read_jsonl(path)] == [1, 2]
    path.unlink()
    path.mkdir()
    with pytest.raises(StorageError) as error:
        JsonlWriter(path).cut_after(1)
    assert_one_line(error.value, "cannot read", path)


def test_what_a_stale_process_records_is_not_read(path):
    stale = JsonlWriter(path)
    stale.append({"iteration": 1})
    stale.append({"iteration": 2})
    fresh = JsonlWriter(path)
    fresh.cut_after(2)  # the same bytes, in another file
    fresh.append({"iteration": 3, "by": "fresh"})
    with pytest.raises(StorageError, match="another process has put a file of its own in its place"):
        stale.append({"iteration": 3})
    assert [row.get("by") for row in read_jsonl(path)] == [None, None, "fresh"]
