import os

import pytest

from service.io import files
from service.io.errors import StorageError
from service.io.files import Appender
from tests.runtime.runs import assert_one_line, no_room_above


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


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="/dev/full, which refuses every write, is Linux only")
def test_a_device_that_is_always_full(tmp_path):
    path = tmp_path / "pieces"
    path.symlink_to("/dev/full")
    with pytest.raises(StorageError) as error:
        Appender(path).append_bytes(b"a")
    assert_one_line(error.value, "cannot write", path, "No space left on device")


@pytest.mark.parametrize("somebody_reads", [False, True])
def test_nobody_waits_for_a_fifo(path, somebody_reads):
    path.parent.mkdir()
    os.mkfifo(path)
    reader = os.open(path, os.O_RDONLY | os.O_NONBLOCK) if somebody_reads else None
    with pytest.raises(StorageError) as error:
        Appender(path).append_bytes(b"a")
    assert_one_line(error.value, "cannot write", path, "not a regular file" if somebody_reads else "No such device")
    with pytest.raises(StorageError) as error:
        files.check_regular(path)
    assert_one_line(error.value, "cannot read", path, "not a regular file")
    files.check_regular(path.with_name("missing"))
    if reader is not None:
        os.close(reader)


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
