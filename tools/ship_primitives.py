"""Put a champion into the package: the primitives that come with ``pip install``.

    tandem publish runs/cube
    python -m tools.ship_primitives panda-cube@latest --registry registry

``service/registry/data`` is a registry like any other, except that only this script writes there. What it ships gets
the next number and the aliases champion and latest; older versions of its name are removed: the package stays small.
"""

from __future__ import annotations

import argparse
import shutil
from collections.abc import Iterator
from pathlib import Path

from pydantic import JsonValue

from benchmarks.measuring import one_line_errors
from service.base import tensors
from service.base.errors import TandemError
from service.base.files import os_errors, write_atomic
from service.policies.numpy_policy import NumpyMCPPolicy
from service.registry.bundled import BUNDLED
from service.registry.manifest import acting_config
from service.registry.names import LATEST, Version
from service.registry.registry import Registry

CHAMPION = "champion"


def ship(reference: str, source: Registry, target: Path) -> Version:
    """Copy a version into the bundled registry as the only one of its name.

    Args:
        reference: of the version.
        source: where it is.
        target: root of the bundled registry.
    """
    manifest, parameters = source.load(reference)
    NumpyMCPPolicy(parameters)
    acting_config(manifest.config, where=f"the manifest of {reference}")
    for text in _texts(manifest.model_dump(mode="json")):
        if text.startswith(("/", "~")):
            raise TandemError(f"{reference}: its manifest names the path {text!r}, which only one machine has")

    name = manifest.name
    number = max((version.number for version in Registry(target).versions(name)), default=0) + 1
    # its parent is a number of the source's, and means nothing here
    shipped = manifest.model_copy(update={"version": number, "parent": None})
    model = target / "models" / name
    with os_errors("write", target):
        digest = Registry(target).put_blob(tensors.encode(parameters))
        assert digest == manifest.blob_sha256
        shutil.rmtree(model, ignore_errors=True)
        write_atomic(model / "versions" / str(number), shipped.to_bytes())
        for alias in (CHAMPION, LATEST):
            write_atomic(model / "aliases" / alias, f"{number}\n".encode())
        _remove_unused_blobs(Registry(target))
    return Version(name, number)


def _remove_unused_blobs(registry: Registry) -> None:
    versions = [version for name in registry.names() for version in registry.versions(name)]
    used = {registry.manifest(str(version)).blob_sha256 for version in versions}
    for path in (registry.root / "blobs" / "sha256").iterdir():
        if path.name not in used:
            path.unlink()


def _texts(value: JsonValue) -> Iterator[str]:
    if isinstance(value, str):
        yield value
    for inner in value.values() if isinstance(value, dict) else value if isinstance(value, list) else ():
        yield from _texts(inner)


@one_line_errors
def main() -> int:
    """Parse the command line, ship, verify."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("reference", metavar="NAME@ALIAS")
    parser.add_argument("--registry", type=Path, default=Path("registry"), metavar="DIR", help="has it")
    given = parser.parse_args()
    version = ship(given.reference, Registry(given.registry), BUNDLED)
    bundled = Registry(BUNDLED)
    manifest = bundled.manifest(str(version))
    for name, value in manifest.metrics.items():
        print(f"{name:<36} {value:g}")
    print(f"{version} is in {BUNDLED}, {manifest.blob_bytes / 1000:.0f} kB; commit that directory")
    return 1 if bundled.verify() else 0


if __name__ == "__main__":
    raise SystemExit(main())
