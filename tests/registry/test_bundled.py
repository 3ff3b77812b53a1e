"""What comes with the package: found where the user has nothing of that name, never written, whole and small."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from service.base.errors import RegistryError, UnknownVersionError
from service.registry.bundled import BUNDLED, find_version, is_bundled
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


def test_an_own_version_hides_nothing_that_it_does_not_have(registry: Registry, publish: Publish) -> None:
    publish()
    champion = Registry(BUNDLED).resolve("panda-cube@champion")
    assert champion.number > 1
    for reference in ("panda-cube@champion", str(champion)):
        found, version = find_version(reference, registry.root)
        assert (is_bundled(found), version) == (True, champion)
    for reference in ("panda-cube", "panda-cube@latest", "panda-cube@1"):
        found, version = find_version(reference, registry.root)
        assert (found.root, version) == (registry.root, Version("panda-cube", 1))


def test_what_the_users_registry_has_is_the_users(registry: Registry, publish: Publish) -> None:
    champion = Registry(BUNDLED).resolve("panda-cube@champion")
    for _ in range(champion.number):
        publish()
    registry.set_alias("panda-cube", "champion", 2)
    for reference, number in (("panda-cube@champion", 2), (str(champion), champion.number)):
        found, version = find_version(reference, registry.root)
        assert (found.root, version) == (registry.root, Version("panda-cube", number))


def test_an_own_alias_of_a_version_that_is_gone_is_no_other_version(registry: Registry, publish: Publish) -> None:
    publish()
    publish()
    registry.set_alias("panda-cube", "champion", 1)
    (registry.root / "models" / "panda-cube" / "versions" / "1").unlink()
    with pytest.raises(UnknownVersionError, match="champion -> 1"):
        find_version("panda-cube@champion", registry.root)


def test_what_is_nowhere(registry: Registry, publish: Publish) -> None:
    publish("panda-cup")
    with pytest.raises(UnknownVersionError) as error:
        find_version("nobody", registry.root)
    assert f"no 'nobody' in the registry {registry.root}; it holds: panda-cup" in str(error.value)
    assert "with tandem comes: panda-cube" in str(error.value)
    with pytest.raises(UnknownVersionError) as error:
        find_version("panda-cup@9", registry.root)
    assert "with tandem comes" not in str(error.value)  # the name is right
    with pytest.raises(UnknownVersionError) as error:
        find_version("panda-cube@best", registry.root)
    assert f"no alias 'best' in the registry {BUNDLED}" in str(error.value)
    assert f"no 'panda-cube' in the registry {registry.root}" in str(error.value)
    with pytest.raises(UnknownVersionError, match="no alias 'best'"):
        find_version("panda-cube@best", BUNDLED)
    publish()
    for target, missing in (("best", "alias 'best'"), ("99", "version 99")):
        with pytest.raises(UnknownVersionError) as error:
            find_version(f"panda-cube@{target}", registry.root)
        own = f"no {missing} in the registry {registry.root}; versions: 1 to 1; aliases: latest -> 1"
        assert own in str(error.value)
        assert "; nor does one come with tandem: " in str(error.value)
        assert f"no {missing} in the registry {BUNDLED}" in str(error.value)
        assert "\n" not in str(error.value)


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
        file = BUNDLED / "models" / name / "versions" / str(version.number)
        assert registry.manifest(name).to_bytes() == file.read_bytes()  # as who fetches it writes it
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
