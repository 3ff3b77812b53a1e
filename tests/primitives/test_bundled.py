"""What comes with the package: found where the user has nothing of that name, never written, whole and small."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from service.primitives.bundled import BUNDLED, find_version, is_bundled
from service.registry.errors import RegistryError, UnknownVersionError
from service.registry.names import Version
from service.registry.registry import Registry
from tests.registry.helpers import Publish, files_in

MAX_BYTES = 5_000_000


def test_the_users_own_comes_first(registry: Registry, publish: Publish) -> None:
    publish()
    publish()
    found, version = find_version("panda-cube", registry.root)
    assert (found.root, version) == (registry.root, Version("panda-cube", 2))
    assert not is_bundled(found)


@pytest.mark.parametrize("others", [(), ("panda-cup",)])
def test_a_name_the_user_does_not_have_is_looked_up_in_the_package(
    registry: Registry, publish: Publish, others: tuple[str, ...]
) -> None:
    for name in others:
        publish(name)
    found, version = find_version("panda-cube@champion", registry.root)
    assert is_bundled(found)
    assert version == Registry(BUNDLED).resolve("panda-cube@champion")
    assert registry.root.exists() == bool(others)


def test_an_alias_of_the_users_own_name_is_not_looked_up_in_the_package(registry: Registry, publish: Publish) -> None:
    publish()
    with pytest.raises(UnknownVersionError) as error:
        find_version("panda-cube@champion", registry.root)
    assert f"no alias 'champion' in the registry {registry.root}; versions: 1 to 1" in str(error.value)
    assert f"hides the one that comes with tandem, which is in --registry {BUNDLED}" in str(error.value)
    assert is_bundled(find_version("panda-cube@champion", BUNDLED)[0])


def test_what_is_nowhere(registry: Registry, publish: Publish) -> None:
    publish("panda-cup")
    with pytest.raises(UnknownVersionError) as error:
        find_version("nobody", registry.root)
    assert f"no 'nobody' in the registry {registry.root}; it holds: panda-cup" in str(error.value)
    assert "with tandem comes: panda-cube" in str(error.value)
    with pytest.raises(UnknownVersionError) as error:
        find_version("panda-cube@best", registry.root)
    assert f"no alias 'best' in the registry {BUNDLED}" in str(error.value)
    assert f"the registry {registry.root} has no panda-cube" in str(error.value)
    with pytest.raises(UnknownVersionError, match="no alias 'best'"):
        find_version("panda-cube@best", BUNDLED)


@pytest.mark.parametrize("through", ["path", "detour", "link"])
def test_nothing_is_written_there(tmp_path: Path, through: str) -> None:
    (tmp_path / "link").symlink_to(BUNDLED)
    roots = {"path": BUNDLED, "detour": BUNDLED / ".." / BUNDLED.name, "link": tmp_path / "link"}
    registry, before = Registry(roots[through]), files_in(BUNDLED)
    fields = {"spaces": {}, "normalisation": {}, "config": {}, "metrics": {}}
    for name in ("panda-cube", "mine"):
        with pytest.raises(RegistryError, match=r"cannot write .*only read; name another directory with --registry"):
            registry.publish(name, {"a": np.zeros(1)}, **fields)
    with pytest.raises(RegistryError, match=r"cannot write .*only read"):
        registry.set_alias("panda-cube", "best", registry.resolve("panda-cube").number)
    assert files_in(BUNDLED) == before
    assert list(BUNDLED.rglob(".*")) == []  # no lock, nothing temporary


def test_what_is_there_is_whole_small_and_of_no_machine() -> None:
    registry = Registry(BUNDLED)
    assert registry.verify() == []
    assert "panda-cube" in registry.names()
    for name in registry.names():
        (version,) = registry.versions(name)
        assert registry.aliases(name) == {"champion": version.number, "latest": version.number}
        texts = list(_texts(registry.manifest(name).model_dump(mode="json")))
        assert name in texts
        assert [text for text in texts if text.startswith(("/", "~"))] == []
    blobs = {path.name for path in (BUNDLED / "blobs" / "sha256").iterdir()}
    assert blobs == {registry.manifest(name).blob_sha256 for name in registry.names()}
    assert sum(len(data) for data in files_in(BUNDLED).values()) < MAX_BYTES


def _texts(value: object) -> Iterator[str]:
    if isinstance(value, str):
        yield value
    elif isinstance(value, dict | list):
        for inner in value.values() if isinstance(value, dict) else value:
            yield from _texts(inner)
