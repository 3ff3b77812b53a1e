import json

import numpy as np
import pytest

from service.errors import TandemError
from service.io.jsonl import JsonlWriter, read_jsonl


@pytest.fixture
def path(tmp_path):
    return tmp_path / "run" / "metrics.jsonl"


def _write(path, text):
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(text)


def test_what_is_appended_is_read_back_in_order(path):
    writer = JsonlWriter(path)
    writer.append({"iteration": 0, "alice/valid_fraction": 0.25})
    JsonlWriter(path).append({"iteration": 1})
    assert path.read_bytes() == b'{"iteration": 0, "alice/valid_fraction": 0.25}\n{"iteration": 1}\n'
    assert read_jsonl(path) == [{"iteration": 0, "alice/valid_fraction": 0.25}, {"iteration": 1}]


def test_numpy_values_become_plain_and_what_json_lacks_becomes_null(path):
    goals = np.array([[0.5, np.nan]])
    JsonlWriter(path).append({"iteration": np.int64(3), "a": np.float32(0.5), "b": float("inf"), "goals": goals})
    assert path.read_text() == '{"iteration": 3, "a": 0.5, "b": null, "goals": [[0.5, null]]}\n'


@pytest.mark.parametrize("torn", [b'{"iteration": 2, "x', b"{", b'{"a": "\xc3', b"\x00\x00"])
def test_a_torn_last_line_is_passed_over(path, torn):
    _write(path, b'{"iteration": 0}\n{"iteration": 1}\n' + torn)
    assert [record["iteration"] for record in read_jsonl(path)] == [0, 1]


def test_a_whole_last_line_without_its_line_end_counts(path):
    _write(path, b'{"iteration": 0}\n{"iteration": 1}')
    assert len(read_jsonl(path)) == 2


def test_an_empty_file_has_no_records(path):
    _write(path, b"")
    assert read_jsonl(path) == []


@pytest.mark.parametrize("line", [b"{", b"[1]", b"", b"\xff"])
def test_a_damaged_line_before_the_last_is_named(path, line):
    _write(path, b'{"iteration": 0}\n' + line + b'\n{"iteration": 2}\n')
    with pytest.raises(TandemError, match=r"metrics\.jsonl line 2"):
        read_jsonl(path)


def test_a_missing_file_is_one_line_for_the_user(path):
    with pytest.raises(TandemError, match=r"cannot read .*metrics\.jsonl") as caught:
        read_jsonl(path)
    assert "\n" not in str(caught.value)


def test_truncate_keeps_the_bytes_up_to_the_iteration_and_drops_the_rest(path):
    _write(path, b'{"iteration": 0}\n{"iteration":   1, "x": 1e0}\n{"iteration": 2}\n{"iterat')
    writer = JsonlWriter(path)
    writer.truncate_after(1)
    assert path.read_bytes() == b'{"iteration": 0}\n{"iteration":   1, "x": 1e0}\n'
    writer.append({"iteration": 2})
    assert [record["iteration"] for record in read_jsonl(path)] == [0, 1, 2]
    assert list(path.parent.iterdir()) == [path]


def test_truncate_ends_a_kept_line_that_lost_its_line_end(path):
    _write(path, b'{"iteration": 0}\n{"iteration": 1}')
    JsonlWriter(path).truncate_after(5)
    assert path.read_bytes() == b'{"iteration": 0}\n{"iteration": 1}\n'


def test_truncate_before_the_first_empties_and_a_missing_file_stays_missing(path):
    writer = JsonlWriter(path)
    writer.truncate_after(0)
    assert not path.exists()
    writer.append({"iteration": 0})
    writer.truncate_after(-1)
    assert path.read_bytes() == b""


@pytest.mark.parametrize("record", [{}, {"iteration": None}, {"iteration": "1"}])
def test_truncate_leaves_a_file_it_cannot_judge_as_it_was(path, record):
    _write(path, b'{"iteration": 0}\n' + json.dumps(record).encode() + b"\n")
    before = path.read_bytes()
    with pytest.raises(TandemError, match="iteration"):
        JsonlWriter(path).truncate_after(0)
    assert path.read_bytes() == before


def test_a_file_that_cannot_be_written_is_one_line_for_the_user(tmp_path):
    (tmp_path / "run").write_text("a file where a directory should be")
    with pytest.raises(TandemError, match=r"cannot write .*metrics\.jsonl"):
        JsonlWriter(tmp_path / "run" / "metrics.jsonl").append({"iteration": 0})
