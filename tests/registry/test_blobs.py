"""Blobs are what their names say, or an error."""

import hashlib
from collections.abc import Callable
from pathlib import Path

import pytest

from service.base.errors import DamagedBlobError, StorageError
from service.registry.blobs import BlobStore


def test_put_and_get(tmp_path: Path) -> None:
    store = BlobStore(tmp_path)
    digest = store.put(b"primitives")
    assert digest == hashlib.sha256(b"primitives").hexdigest()
    assert store.get(digest) == b"primitives"
    assert (tmp_path / "sha256" / digest).read_bytes() == b"primitives"


def test_equal_bytes_are_written_once_and_damaged_ones_again(tmp_path: Path) -> None:
    store = BlobStore(tmp_path)
    digest = store.put(b"primitives")
    written = store.path(digest).stat().st_ino
    store.put(b"primitives")
    assert store.path(digest).stat().st_ino == written
    store.path(digest).write_bytes(b"primitiveS")
    store.put(b"primitives")
    assert store.get(digest) == b"primitives"


def test_a_flipped_bit_names_file_and_digests(tmp_path: Path) -> None:
    store = BlobStore(tmp_path)
    digest = store.put(b"primitives")
    store.path(digest).write_bytes(b"primitiver")
    actual = hashlib.sha256(b"primitiver").hexdigest()
    with pytest.raises(DamagedBlobError) as caught:
        store.get(digest)
    message = str(caught.value)
    assert "\n" not in message
    for part in (str(store.path(digest)), f"expected sha256 {digest}", f"it has {actual}", "publish the same"):
        assert part in message


def test_a_missing_blob(tmp_path: Path) -> None:
    with pytest.raises(DamagedBlobError, match=r"blob .*00 is missing; restore"):
        BlobStore(tmp_path).get("00" * 32)


@pytest.mark.parametrize("call", ["write", "fsync"])
def test_a_full_disk_leaves_nothing_half_written(tmp_path: Path, full_disk: Callable[[str], None], call: str) -> None:
    store = BlobStore(tmp_path)
    first = store.put(b"first")
    full_disk(call)
    with pytest.raises(StorageError, match=r"cannot write .*: No space left on device \([0-9]+ bytes free there\)"):
        store.put(b"second")
    assert [path.name for path in (tmp_path / "sha256").iterdir()] == [first]
