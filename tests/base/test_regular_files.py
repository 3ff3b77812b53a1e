"""Regular files are opened, and nothing else is waited for."""

import os

import pytest

from service.base.files import open_regular, open_to_append, read_regular


@pytest.fixture
def path(tmp_path):
    path = tmp_path / "file"
    path.write_bytes(b"12345")
    return path


def test_a_file_is_read_whole(path):
    assert read_regular(path, 5) == b"12345"
    with open_regular(path) as file:
        assert file.read() == b"12345"


def test_no_more_than_that_is_read(path):
    with pytest.raises(OSError, match="longer than 4 bytes"):
        read_regular(path, 4)
    with path.open("wb") as file:
        file.truncate(1 << 40)  # without a block on the disk
    with pytest.raises(OSError, match="longer than 5 bytes"):
        read_regular(path, 5)


def test_a_file_whose_size_says_nothing_is_not_read_on_and_on():
    """Files of the kernel have a size of 0."""
    with pytest.raises(OSError, match="longer than 10 bytes"):
        read_regular("/proc/self/status", 10)


def test_links_are_followed_where_they_may_be(path, tmp_path):
    link = tmp_path / "link"
    link.symlink_to(path)
    assert read_regular(link, 5, follow=True) == b"12345"
    for read in (open_regular, open_to_append, lambda path: read_regular(path, 5)):
        with pytest.raises(OSError, match="a symbolic link, which is not followed"):
            read(link)


@pytest.mark.parametrize("make", [os.mkfifo, os.mkdir, lambda path: path.symlink_to("/dev/zero")])
def test_what_is_no_file(tmp_path, make):
    path = tmp_path / "other"
    make(path)
    before = len(os.listdir("/proc/self/fd"))
    for _ in range(3):
        with pytest.raises(OSError, match="not a regular file"):
            open_regular(path, follow=True)
        with pytest.raises(OSError, match=r"not a regular file|Is a directory|not followed"):
            open_to_append(path)
    assert len(os.listdir("/proc/self/fd")) == before
