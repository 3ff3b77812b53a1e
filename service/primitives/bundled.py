"""The primitives that come with the package, and the look-up of a reference in both registries."""

from __future__ import annotations

from pathlib import Path

from service.registry.errors import UnknownVersionError
from service.registry.names import Version, split_reference
from service.registry.registry import Registry

BUNDLED = Path(__file__).parent / "data"
"""The registry that comes with the package; it is only read."""


def find_version(reference: str, root: Path) -> tuple[Registry, Version]:
    """Find a version in the registry at ``root`` or, where that has nothing of this name, in the bundled one.

    A name is never looked up in both: its versions and aliases all belong to one registry.

    Args:
        reference: NAME, NAME@VERSION or NAME@ALIAS.
        root: of the user's registry; need not exist.

    Raises:
        UnknownVersionError: in neither; the message says what there is.
        RegistryError: not a reference, or a damaged alias.
    """
    own, bundled = Registry(root), Registry(BUNDLED)
    if is_bundled(own):
        return own, own.resolve(reference)
    name, _ = split_reference(reference)
    registry = bundled if bundled.versions(name) and not own.versions(name) else own
    try:
        return registry, registry.resolve(reference)
    except UnknownVersionError as error:
        raise UnknownVersionError(f"{error}; {_elsewhere(name, own, bundled)}") from None


def is_bundled(registry: Registry) -> bool:
    """Whether this is the registry that comes with the package."""
    return registry.root.resolve() == BUNDLED.resolve()


def _elsewhere(name: str, own: Registry, bundled: Registry) -> str:
    if not bundled.versions(name):
        return f"with tandem comes: {', '.join(bundled.names()) or 'nothing'}"
    if own.versions(name):
        return f"this {name} hides the one that comes with tandem, which is in --registry {bundled.root}"
    return f"the registry {own.root} has no {name} at all"
