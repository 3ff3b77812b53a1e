"""Files that grow by whole pieces, new directories, and regular files, beside which nothing is waited for."""

import os

import pytest

from service.base import files
from service.base.errors import StorageError
from service.base.files import (
    Appender,
    new_directory,
    open_regular,
    open_to_append,
    read_regular,
    write_atomic,
    write_exclusive,
)
from tests.runs.runs import assert_one_line, no_room_above


@pytest.fixture
def path(tmp_path):
    return tmp_path / "run" / "pieces"


def test_pieces_come_one_after_the_other_behind_what_is_there(path):
    appender = Appender(path)
    assert not path.parent.exists()
    appender.append_bytes(b"ab")
    Appender(path).append_bytes(b"c")
    appender.append_bytes(b"d")
    assert path.read_bytes() == b"abcd"
    assert path.stat().st_mode & 0o111 == 0  # nobody runs it
    path.unlink()
    appender.append_bytes(b"e")  # a file that was removed begins anew
    assert path.read_bytes() == b"e"


def test_a_piece_that_does_not_fit_leaves_no_part_and_comes_before_the_next(path):
    appender = Appender(path)
    appender.append_bytes(b"aaa")
    with no_room_above(5), pytest.raises(StorageError) as error:
        appender.append_bytes(b"bbb")  # the kernel takes two of its bytes
    assert_one_line(error.value, "cannot write", path, "File too large")
    assert path.read_bytes() == b"aaa"
    appender.append_bytes(b"cc")
    assert path.read_bytes() == b"aaabbbcc"
    appender.sync()
    assert path.read_bytes() == b"aaabbbcc"


def test_a_part_is_taken_back_when_a_signal_comes_between_two_writes(path, monkeypatch):
    class Interrupted:
        def __init__(self, file):
            self._file, self._calls = file, 0

        def __getattr__(self, name):
            return getattr(self._file, name)

        def __enter__(self):
            return self

        def __exit__(self, *error):
            self._file.close()

        def write(self, data):
            self._calls += 1
            if self._calls == 2:
                raise KeyboardInterrupt
            return self._file.write(data[:2])

    appender = Appender(path)
    appender.append_bytes(b"aaa")
    monkeypatch.setattr(files, "open_to_append", lambda path: Interrupted(open_to_append(path)))
    with pytest.raises(KeyboardInterrupt):
        appender.append_bytes(b"bbb")
    assert path.read_bytes() == b"aaa"


def test_a_new_directory_takes_its_name_when_all_is_well_and_not_before(tmp_path):
    path = tmp_path / "out" / "folder"
    with files.new_directory(path) as temporary:
        (temporary / "file").write_text("whole")
        assert not path.exists()
    assert [each.name for each in path.parent.iterdir()] == ["folder"]
    with pytest.raises(StorageError) as error, files.new_directory(path):
        pass
    assert_one_line(error.value, "cannot write", path, "it exists")
    assert (path / "file").read_text() == "whole"


def test_nothing_is_left_of_a_new_directory_that_was_not_finished(tmp_path):
    with pytest.raises(KeyboardInterrupt), files.new_directory(tmp_path / "folder"):
        raise KeyboardInterrupt
    with pytest.raises(StorageError, match="cannot write"), files.new_directory(tmp_path / "other"):
        (tmp_path / "other" / "of another process").mkdir(parents=True)
    assert sorted(each.name for each in tmp_path.iterdir()) == ["other"]


def test_what_killed_writers_left_is_removed_but_no_directory(tmp_path):
    """It may be of an export that goes on."""
    (tmp_path / ".tmp-1-aa").write_text("torn")
    (tmp_path / ".tmp-2-bb").mkdir()
    files.remove_temporaries(tmp_path)
    assert [each.name for each in tmp_path.iterdir()] == [".tmp-2-bb"]


def test_a_place_that_cannot_be_written_is_known_before(tmp_path):
    files.check_place(tmp_path / "new" / "file")
    assert list((tmp_path / "new").iterdir()) == []
    (tmp_path / "file").write_text("whole")
    for path, said in (
        (tmp_path, "Is a directory; check the path and its permissions"),  # room on the disk would not help
        (tmp_path / "file" / "below", f"{tmp_path / 'file'} is no directory; name another place"),
    ):
        with pytest.raises(StorageError) as error:
            files.check_place(path)
        assert_one_line(error.value, f"cannot write {path}: {said}")


# --- regular files ---------------------------------------------------------------------------------------------------


def test_a_file_is_read_whole_and_no_more_than_is_allowed(tmp_path):
    path, link = tmp_path / "file", tmp_path / "link"
    path.write_bytes(b"12345")
    link.symlink_to(path)
    assert read_regular(path, 5) == read_regular(link, 5, follow=True) == b"12345"
    with pytest.raises(OSError, match="longer than 4 bytes"):
        read_regular(path, 4)
    with path.open("wb") as file:
        file.truncate(1 << 40)  # without a block on the disk
    with pytest.raises(OSError, match="longer than"):
        read_regular(path)


def test_the_last_lines_of_a_text_are_whole_and_not_empty(tmp_path, monkeypatch):
    path = tmp_path / "log.txt"
    assert files.last_lines(path) == []
    path.write_bytes(b"one\n\n1 %\r2 %\r\nno t\xffext")
    assert files.last_lines(path) == ["one", "1 %", "2 %", "no t\ufffdext"]
    monkeypatch.setattr(files, "END_BYTES", 13)
    assert files.last_lines(path) == ["no t\ufffdext"]  # of the line before, a part


@pytest.mark.parametrize("make", [os.mkfifo, os.mkdir, lambda path: path.symlink_to("/dev/zero")])
def test_what_is_no_file_is_neither_read_nor_written(tmp_path, make):
    path = tmp_path / "other"
    make(path)
    before = len(os.listdir("/proc/self/fd"))
    for _ in range(3):
        with pytest.raises(OSError, match="not a regular file"):
            open_regular(path, follow=True)
        with pytest.raises(OSError, match=r"not a regular file|Is a directory|not followed"):
            open_to_append(path)
    assert len(os.listdir("/proc/self/fd")) == before


def test_what_a_link_leads_to_is_not_changed(tmp_path):
    (tmp_path / "precious").write_text("precious")
    (tmp_path / "link").symlink_to("precious")
    for use in (open_regular, open_to_append, read_regular):
        with pytest.raises(OSError, match="a symbolic link"):
            use(tmp_path / "link")
    with pytest.raises(StorageError) as error:
        Appender(tmp_path / "link").append_bytes(b"a")
    assert_one_line(error.value, "cannot write", tmp_path / "link", "a symbolic link")
    assert (tmp_path / "precious").read_text() == "precious"


def test_a_file_and_then_its_directory_are_flushed_or_nothing(tmp_path, monkeypatch):
    flushed = []
    monkeypatch.setattr(os, "fsync", lambda descriptor: flushed.append(os.readlink(f"/proc/self/fd/{descriptor}")))
    write_atomic(tmp_path / "a", b"x")
    assert len(flushed) == 2
    assert flushed[0] != flushed[1] == str(tmp_path)
    flushed.clear()
    assert write_exclusive(tmp_path / "b", b"x")
    assert len(flushed) == 2
    assert flushed[0] != flushed[1] == str(tmp_path)
    flushed.clear()
    with new_directory(tmp_path / "c"):
        pass
    assert flushed == [str(tmp_path)]
    flushed.clear()
    write_atomic(tmp_path / "a", b"x", flush=False)
    assert flushed == []
