import zlib

import numpy as np
import pytest

from service.base.errors import TandemError
from service.base.jsonl import Extent, JsonlWriter, read_jsonl


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


def test_the_extent_is_of_what_was_appended_or_kept(path):
    writer = JsonlWriter(path)
    assert writer.extent == (0, 0)
    for iteration in range(3):
        writer.append({"iteration": iteration})
    assert writer.extent == (len(path.read_bytes()), zlib.crc32(path.read_bytes()))
    writer.cut(34)
    writer.append({"iteration": 2, "x": 1})
    assert path.read_bytes() == b'{"iteration": 0}\n{"iteration": 1}\n{"iteration": 2, "x": 1}\n'
    assert writer.extent == Extent.of(path.read_bytes())
    assert list(path.parent.iterdir()) == [path]


def test_damage_is_found_in_what_the_extent_knows_alone(path):
    _write(path, b'{"iteration": 0}\n{"iteration": 1}\n')
    writer = JsonlWriter(path)
    for known in (0, 17, 34):
        assert writer.damage(Extent.of(path.read_bytes()[:known])) is None
    assert writer.damage(Extent(34, 7)) == "has other first 34 bytes than were written"
    assert writer.damage(Extent(1234, 7)) == "has 34 bytes, and had 1,234 when the checkpoint was saved"
    path.unlink()
    assert "has 0 bytes" in writer.damage(Extent(34, 7))
    assert writer.damage(Extent()) is None


def test_a_cut_of_a_missing_file_leaves_it_missing(path):
    writer = JsonlWriter(path)
    writer.cut(0)
    writer.cut_after(5)
    assert not path.exists()


def test_a_cut_by_iterations_keeps_the_bytes_of_records_in_their_order(path, caplog):
    _write(path, b'{"iteration":   1, "x": 1e0}\n{"iteration": 2}\n{"iterat')
    JsonlWriter(path).cut_after(1)
    assert path.read_bytes() == b'{"iteration":   1, "x": 1e0}\n'
    assert caplog.messages == []
    strange = b'[1]\n\xff\n{}\n{"iteration": "1"}\n{"iteration": null}\n{"iteration": 0}\n'
    _write(path, b'{"iteration": 1}\n' + strange + b'{"iteration": 3}\n{"iteration": 4}\n')
    before = path.read_bytes()
    with pytest.raises(TandemError, match=r"metrics\.jsonl line 2: b'\[1\]' is no record"):
        JsonlWriter(path).cut_after(3)
    assert path.read_bytes() == before
    JsonlWriter(path).cut_after(3, accept_damage=True)
    assert path.read_bytes() == b'{"iteration": 1}\n{"iteration": 3}\n'
    assert caplog.messages == [f"{path}: left out 6 lines that are no records in their order"]


def test_a_file_that_cannot_be_written_is_one_line_for_the_user(tmp_path):
    (tmp_path / "run").write_text("a file where a directory should be")
    with pytest.raises(TandemError, match=r"cannot write .*metrics\.jsonl"):
        JsonlWriter(tmp_path / "run" / "metrics.jsonl").append({"iteration": 0})
