"""Versions are whole, unique, contiguous and unchanging; aliases move."""

import errno
import fcntl
import hashlib
import json
import os
import re
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import safetensors.numpy

from service.base.errors import DamagedBlobError, FormatVersionError, RegistryError, StorageError, UnknownVersionError
from service.base.files import write_exclusive
from service.registry.manifest import parse_manifest
from service.registry.names import Version
from service.registry.registry import Registry
from tests.registry.helpers import Publish, arrays_of_all_kinds, assert_identical, files_in
from tests.runs.runs import assert_one_line


def test_round_trip(registry: Registry, publish: Publish) -> None:
    arrays = arrays_of_all_kinds()
    version = registry.publish(
        "panda-cube",
        arrays,
        spaces={"action": {"shape": [4]}},
        normalisation={"mean": [0.1]},
        config={"seed": 3},
        metrics={"bob/success_rate": np.float32(0.25)},
    )
    assert version == Version("panda-cube", 1)
    manifest, loaded = registry.load("panda-cube")
    assert_identical(loaded, arrays)
    assert manifest.reference == "panda-cube@1"
    assert manifest.format_version == 1
    assert manifest.spaces == {"action": {"shape": [4]}}
    assert manifest.normalisation == {"mean": [0.1]}
    assert manifest.config == {"seed": 3}
    assert manifest.metrics == {"bob/success_rate": 0.25}
    assert manifest.parent is None
    assert manifest.created.endswith("+00:00")
    assert manifest.tensors["float32.transposed"].shape == (6, 4)
    assert manifest.tensors["uint64"].dtype == "uint64"


def test_versions_aliases_and_references(registry: Registry, publish: Publish) -> None:
    for value in (1.0, 2.0, 3.0):
        publish(value=value)
    publish("panda-sphere")
    registry.set_alias("panda-cube", "champion", 3)
    registry.set_alias("panda-cube", "champion", 2)
    assert registry.names() == ["panda-cube", "panda-sphere"]
    assert registry.versions("panda-cube") == [Version("panda-cube", number) for number in (1, 2, 3)]
    assert registry.aliases("panda-cube") == {"champion": 2, "latest": 3}
    assert str(registry.resolve("panda-cube")) == "panda-cube@3"
    assert registry.resolve("panda-cube@1").number == 1
    assert registry.load("panda-cube@champion")[1]["gate.weight"][0, 0] == 2.0


def test_equal_parameters_share_one_blob_but_not_a_version(registry: Registry, publish: Publish) -> None:
    assert publish().number == 1
    assert publish().number == 2
    assert len(list((registry.root / "blobs" / "sha256").iterdir())) == 1


def test_a_parent_is_named_with_its_version(registry: Registry, publish: Publish) -> None:
    publish(parent=publish())
    assert [registry.manifest(f"panda-cube@{number}").parent for number in (1, 2)] == [None, "panda-cube@1"]


def test_unknown_references_list_what_exists(registry: Registry, publish: Publish) -> None:
    with pytest.raises(UnknownVersionError, match="nothing is published there"):
        registry.resolve("panda-cube")
    publish()
    publish()
    with pytest.raises(UnknownVersionError, match=r"no 'panda-cup' in the registry .*; it holds: panda-cube"):
        registry.resolve("panda-cup")
    with pytest.raises(UnknownVersionError, match=r"no alias 'best' .*; versions: 1 to 2; aliases: latest -> 2"):
        registry.resolve("panda-cube@best")
    for number in (0, 3):
        with pytest.raises(UnknownVersionError, match=rf"no version {number} "):
            registry.resolve(f"panda-cube@{number}")
    with pytest.raises(UnknownVersionError, match="no version 9 "):
        registry.set_alias("panda-cube", "champion", 9)


BAD_NAMES = ["", "..", "../up", "a/b", ".hidden", "A", "a b", "a\n", "a@1", "x" * 65, "\u00e9", "-a"]


@pytest.mark.parametrize("name", BAD_NAMES)
def test_bad_names_are_refused(registry: Registry, publish: Publish, tmp_path: Path, name: str) -> None:
    with pytest.raises(RegistryError, match="bad name"):
        publish(name)
    with pytest.raises(RegistryError, match="bad reference"):
        registry.resolve(f"{name}@latest")
    with pytest.raises(RegistryError, match="bad name"):
        registry.versions(name)
    assert files_in(tmp_path) == {}


@pytest.mark.parametrize("alias", [*BAD_NAMES, "7", "007", "../../x"])
def test_bad_aliases_and_those_that_read_as_a_version_are_refused(
    registry: Registry, publish: Publish, alias: str
) -> None:
    publish()
    with pytest.raises(RegistryError, match="bad alias"):
        registry.set_alias("panda-cube", alias, 1)
    assert registry.aliases("panda-cube") == {"latest": 1}


@pytest.mark.parametrize("reference", ["panda-cube@", "@latest", "panda-cube@a@b", "panda-cube@-1", "panda-cube@../1"])
def test_bad_references_are_refused(registry: Registry, reference: str) -> None:
    with pytest.raises(RegistryError, match="expected NAME, NAME@VERSION or NAME@ALIAS"):
        registry.resolve(reference)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"metrics": {"bob/success_rate": float("nan")}}, r"metrics.bob/success_rate = nan"),
        ({"config": {"rate": float("inf")}}, "NaN or infinity|finite"),
        ({"spaces": {"low": np.zeros(2)}}, r"spaces\.low"),
    ],
)
def test_values_a_manifest_cannot_hold_publish_nothing(
    registry: Registry, publish: Publish, changes: dict, message: str
) -> None:
    with pytest.raises(RegistryError, match=message):
        publish(**changes)
    assert not registry.root.exists()


def test_an_array_safetensors_cannot_hold_publishes_nothing(registry: Registry) -> None:
    with pytest.raises(RegistryError, match="cannot publish panda-cube: array 'odd'"):
        registry.publish("panda-cube", {"odd": np.array(["a"])}, spaces={}, normalisation={}, config={}, metrics={})
    assert not registry.root.exists()


def test_a_damaged_blob_is_found_and_mended_by_publishing_again(registry: Registry, publish: Publish) -> None:
    publish()
    (blob,) = (registry.root / "blobs" / "sha256").iterdir()
    written = blob.stat().st_ino
    publish()
    assert blob.stat().st_ino == written  # what is whole is not written again
    data = bytearray(blob.read_bytes())
    data[-1] ^= 0x10
    blob.write_bytes(data)
    actual = hashlib.sha256(data).hexdigest()
    said = f"{blob} is damaged: expected sha256 {blob.name}, it has {actual}; restore the file from a copy, or publish"
    with pytest.raises(DamagedBlobError, match=f"^{re.escape(said)} the same parameters again$"):
        registry.load("panda-cube")
    assert [problem.partition(":")[0] for problem in registry.verify()] == ["panda-cube@1", "panda-cube@2"]
    blob.write_bytes(bytes(data[:-5]))
    assert len(registry.verify("panda-cube@1")) == 1
    blob.unlink()
    with pytest.raises(DamagedBlobError, match=f"^blob {re.escape(str(blob))} is missing; restore"):
        registry.load("panda-cube")
    publish()
    assert registry.verify() == []


def test_any_flipped_bit_of_a_manifest_is_found(registry: Registry, publish: Publish) -> None:
    publish()
    path = registry.root / "models" / "panda-cube" / "versions" / "1"
    good = path.read_bytes()
    expected = registry.manifest("panda-cube@1")
    for position in range(0, len(good), 11):
        data = bytearray(good)
        data[position] ^= 1
        path.write_bytes(data)
        try:
            assert registry.manifest("panda-cube@1") == expected  # white space between keys
        except (DamagedBlobError, FormatVersionError):
            continue
        assert good[position : position + 1].isspace()


def test_verify_finds_swapped_manifests_and_dangling_or_damaged_aliases(registry: Registry, publish: Publish) -> None:
    publish()
    publish()
    model = registry.root / "models" / "panda-cube"
    assert registry.verify() == []
    (model / "versions" / "2").write_bytes((model / "versions" / "1").read_bytes())
    (model / "aliases" / "champion").write_bytes(b"9\n")
    assert [problem.split(":")[0] for problem in registry.verify()] == ["panda-cube@2", "panda-cube@champion"]
    (model / "aliases" / "champion").write_bytes(b"\x00")
    assert "champion is damaged" in registry.verify()[1]
    registry.set_alias("panda-cube", "champion", 1)
    assert len(registry.verify()) == 1


def test_a_name_that_may_not_be_read_hides_no_other_and_is_reported(
    registry: Registry, publish: Publish, monkeypatch: pytest.MonkeyPatch
) -> None:
    publish()
    publish("private")
    versions = registry.root / "models" / "private" / "versions"
    is_dir = Path.is_dir

    def refused(path: Path) -> bool:  # root may read everything
        if path == versions:
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))
        return is_dir(path)

    monkeypatch.setattr(Path, "is_dir", refused)
    assert registry.names() == ["panda-cube"]
    (problem,) = registry.verify()
    assert_one_line(problem, f"private: cannot read {versions}: Permission denied")
    with pytest.raises(PermissionError):  # where this name is meant
        registry.versions("private")


def test_another_format_version_is_named(registry: Registry, publish: Publish, tmp_path: Path) -> None:
    publish()
    path = registry.root / "models" / "panda-cube" / "versions" / "1"
    path.write_text(json.dumps({"format_version": 2, "something": "new"}))
    for read in (lambda: registry.load("panda-cube"), lambda: registry.export("panda-cube", tmp_path / "out")):
        with pytest.raises(FormatVersionError, match=r"versions/1: format version 2 found, this tandem reads 1; "):
            read()
    assert "format version 2" in registry.verify()[0]


def test_a_partial_publish_is_invisible(registry: Registry, publish: Publish, monkeypatch: pytest.MonkeyPatch) -> None:
    publish(value=1.0)
    before = files_in(registry.root / "models")
    with monkeypatch.context() as patch:
        patch.setattr("service.registry.registry.write_exclusive", _killed)
        with pytest.raises(KeyboardInterrupt):
            publish(value=2.0)
    versions = registry.root / "models" / "panda-cube" / "versions"
    (versions / ".tmp-1-dead").write_bytes(b"{")  # what kill -9 leaves
    assert registry.versions("panda-cube") == [Version("panda-cube", 1)]
    assert registry.load("panda-cube")[1]["gate.weight"][0, 0] == 1.0
    (versions / ".tmp-1-dead").unlink()
    assert files_in(registry.root / "models") == before
    assert publish(value=2.0).number == 2


def _killed(path: Path, data: bytes) -> bool:
    raise KeyboardInterrupt


@pytest.mark.parametrize("call", ["write", "fsync"])
def test_a_full_disk_changes_nothing(
    registry: Registry, publish: Publish, full_disk: Callable[[str], None], call: str
) -> None:
    publish(value=1.0)
    before = files_in(registry.root)
    full_disk(call)
    with pytest.raises(StorageError, match=r"cannot write .*: No space left on device \([0-9]+ bytes free there\)"):
        publish(value=2.0)
    with pytest.raises(StorageError, match="No space left on device"):
        registry.set_alias("panda-cube", "champion", 1)
    assert files_in(registry.root) == before


def test_an_alias_whose_lock_another_process_keeps(
    registry: Registry, publish: Publish, monkeypatch: pytest.MonkeyPatch
) -> None:
    publish()
    monkeypatch.setattr("service.registry.registry._WAIT_S", 0.05)
    with (registry.root / "models" / "panda-cube" / "aliases" / ".lock").open("rb") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        with pytest.raises(StorageError, match="another process has held"):
            registry.set_alias("panda-cube", "champion", 1)
    assert registry.set_alias("panda-cube", "champion", 1).number == 1


def test_a_file_system_without_locks_takes_versions_where_one_says_so(
    registry: Registry, publish: Publish, monkeypatch: pytest.MonkeyPatch
) -> None:
    def unsupported(*_: object) -> None:
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr("fcntl.flock", unsupported)
    with pytest.raises(StorageError, match=r"no locks .No locks available.*TANDEM_WITHOUT_LOCKS=1"):
        publish()
    monkeypatch.setenv("TANDEM_WITHOUT_LOCKS", "1")
    assert registry.aliases("panda-cube") == {}
    assert registry.resolve(f"panda-cube@{publish().number}")
    assert registry.aliases("panda-cube") == {"latest": 2}


def test_a_slow_publisher_does_not_take_latest_back(
    registry: Registry, publish: Publish, monkeypatch: pytest.MonkeyPatch
) -> None:
    def overtaken(path: Path, data: bytes) -> bool:
        """Between the version and its alias, another publisher makes the next one."""
        written = write_exclusive(path, data)
        if path.name == "2":
            publish()
        return written

    publish()
    with monkeypatch.context() as patch:
        patch.setattr("service.registry.registry.write_exclusive", overtaken)
        assert publish().number == 2
    assert registry.aliases("panda-cube") == {"latest": 3}


_PUBLISHER = """
import sys
from pathlib import Path
import numpy as np
from service.registry.registry import Registry
registry = Registry(Path(sys.argv[1]))
print("ready", flush=True)
sys.stdin.readline()
for index in range(4):
    value = np.full(8, 4 * int(sys.argv[2]) + index, np.int64)
    version = registry.publish("panda-cube", {"value": value}, spaces={}, normalisation={}, config={}, metrics={})
    print(version.number, value[0])
"""


def test_publishes_of_four_processes_are_a_version_each(registry: Registry) -> None:
    stop = threading.Event()
    failures: list[str] = []
    reader = threading.Thread(target=_read_until, args=(registry, stop, failures))
    reader.start()
    outputs = _publish_from_four_processes(registry.root)
    stop.set()
    reader.join()
    published = dict(tuple(map(int, line.split())) for output in outputs for line in output.splitlines())
    assert failures == []
    assert sorted(published) == list(range(1, 17))
    assert sorted(published.values()) == list(range(16))
    assert [version.number for version in registry.versions("panda-cube")] == list(range(1, 17))
    assert registry.aliases("panda-cube") == {"latest": 16}
    assert all(registry.load(f"panda-cube@{number}")[1]["value"][0] == value for number, value in published.items())
    assert registry.verify() == []


def _publish_from_four_processes(root: Path) -> list[str]:
    command = [sys.executable, "-c", _PUBLISHER, str(root)]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    processes = [subprocess.Popen([*command, str(index)], **pipes) for index in range(4)]
    for process in processes:
        assert process.stdout.readline() == "ready\n"
    for process in processes:
        process.stdin.write("go\n")
        process.stdin.flush()
    outputs = [process.communicate()[0] for process in processes]
    assert [process.returncode for process in processes] == [0, 0, 0, 0]
    return outputs


def _read_until(registry: Registry, stop: threading.Event, failures: list[str]) -> None:
    newest = 0
    while not stop.wait(0.002):
        try:
            if registry.versions("panda-cube"):
                number = registry.load(str(registry.versions("panda-cube")[-1]))[0].version
                if number < newest:
                    failures.append(f"{number} after {newest}")
                newest = number
        except StorageError as error:
            failures.append(str(error))


def test_export_is_read_back_without_the_registry(registry: Registry, publish: Publish, tmp_path: Path) -> None:
    publish(value=4.0)
    target = tmp_path / "robot" / "skills"
    exported = registry.export("panda-cube@latest", target)
    assert sorted(path.name for path in target.iterdir()) == ["manifest.json", "primitives.safetensors"]
    manifest = parse_manifest((target / "manifest.json").read_bytes(), target)
    assert manifest == exported == registry.manifest("panda-cube")
    data = (target / "primitives.safetensors").read_bytes()
    assert hashlib.sha256(data).hexdigest() == manifest.blob_sha256
    assert_identical(safetensors.numpy.load(data), registry.load("panda-cube")[1])
    with pytest.raises(RegistryError, match="exists; choose another directory"):
        registry.export("panda-cube", target)


def test_a_registry_that_cannot_be_one_is_refused_before_anything_is_learned(tmp_path: Path) -> None:
    file = tmp_path / "learn.yaml"
    file.touch()
    for root in (file, file / "below"):
        with pytest.raises(RegistryError, match=r"learn.yaml is no directory; name another with --registry"):
            Registry(root).check_writable()
    Registry(tmp_path / "not" / "there" / "yet").check_writable()


def test_a_registry_in_which_only_another_user_may_publish_is_refused(
    registry: Registry, publish: Publish, monkeypatch: pytest.MonkeyPatch
) -> None:
    publish()
    registry.check_writable()
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path).name != "sha256")  # root may do everything
    with pytest.raises(RegistryError, match="sha256 is not writable"):
        registry.check_writable()
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path).name != ".lock")  # made with a umask of 022
    registry.check_writable("another-name")
    with pytest.raises(RegistryError, match=r"panda-cube/aliases/\.lock is not writable; let its owner do chmod a\+w"):
        registry.check_writable("panda-cube")
