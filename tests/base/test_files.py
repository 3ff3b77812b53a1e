import os

import pytest

from service.base import files
from service.base.errors import StorageError
from service.base.files import Appender
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
    with monkeypatch.context() as patch:
        unbuffered = files.open_to_append
        patch.setattr(files, "open_to_append", lambda path: Interrupted(unbuffered(path)))
        with pytest.raises(KeyboardInterrupt):
            appender.append_bytes(b"bbb")
    assert path.read_bytes() == b"aaa"


@pytest.mark.parametrize(
    ("make", "reason"),
    [
        (os.mkfifo, "not a regular file"),
        (lambda path: path.symlink_to("/dev/full"), "a symbolic link, which is not followed"),
        (lambda path: path.symlink_to(path.with_name("precious")), "a symbolic link, which is not followed"),
    ],
)
def test_nothing_is_appended_to_what_is_no_file_of_the_run(path, make, reason):
    path.parent.mkdir()
    path.with_name("precious").write_text("precious")
    make(path)
    with pytest.raises(StorageError) as error:
        Appender(path).append_bytes(b"a")
    assert_one_line(error.value, "cannot write", path, reason)
    assert path.with_name("precious").read_text() == "precious"


def test_a_new_directory_takes_its_name_when_all_is_well_and_not_before(tmp_path):
    path = tmp_path / "out" / "folder"
    with files.new_directory(path) as temporary:
        (temporary / "file").write_text("whole")
        assert not path.exists()
    assert [each.name for each in path.parent.iterdir()] == ["folder"]
    assert (path / "file").read_text() == "whole"
    with pytest.raises(StorageError) as error, files.new_directory(path):
        pass
    assert_one_line(error.value, "cannot write", path, "it exists; name another folder")
    assert (path / "file").read_text() == "whole"


def test_nothing_is_left_of_a_new_directory_that_was_not_finished(tmp_path):
    def begin():
        with files.new_directory(tmp_path / "folder") as temporary:
            (temporary / "file").touch()
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        begin()
    with pytest.raises(StorageError, match="cannot write"), files.new_directory(tmp_path / "other"):
        (tmp_path / "other" / "of another process").mkdir(parents=True)
    assert sorted(each.name for each in tmp_path.iterdir()) == ["other"]
