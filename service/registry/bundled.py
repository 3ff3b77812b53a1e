"""The primitives that come with the package, and the look-up of a reference in both registries."""

from __future__ import annotations

from pathlib import Path

from service.base.errors import UnknownVersionError, did_you_mean
from service.registry.exported import ExportedVersion, is_exported
from service.registry.names import Version, is_service, split_reference
from service.registry.registry import Registry

BUNDLED = Path(__file__).parent / "data"
"""The registry that comes with the package; it is only read."""


def find_version(reference: str, root: Path | str) -> tuple[Registry, Version]:
    """Find a version in the registry at ``root`` or, where that does not have it, in the bundled one.

    What the user's registry has is always the user's. An alias of it that means a missing version is not looked up
    again: the user means a version of their own.

    Args:
        reference: NAME, NAME@VERSION or NAME@ALIAS; or the directory of an exported version.
        root: of the user's registry; need not exist. Or the URL of a ``tandem serve``, which alone is asked.

    Raises:
        UnknownVersionError: in neither; the message says what there is.
        RegistryError: not a reference, or a damaged alias.
        FetchError: the service cannot be reached, or wants a token.
    """
    if is_exported(Path(reference)):
        exported = ExportedVersion(Path(reference))
        return exported, exported.version
    if is_service(root):
        from service.registry.client import fetch_primitives  # its packages, which only a URL needs

        return fetch_primitives(str(root), reference)
    own, bundled = Registry(Path(root)), Registry(BUNDLED)
    try:
        return own, own.resolve(reference)
    except UnknownVersionError as error:
        name, target = split_reference(reference)
        if is_bundled(own) or target in own.aliases(name):
            raise
        if not bundled.versions(name):
            raise UnknownVersionError(
                f"{error}; with tandem comes: {', '.join(bundled.names()) or 'nothing'}"
                f"{did_you_mean(name, [*own.names(), *bundled.names()])}"
            ) from None
        missing = str(error) if own.versions(name) else f"the registry {own.root} has no {name} at all"
    try:
        return bundled, bundled.resolve(reference)
    except UnknownVersionError as error:
        raise UnknownVersionError(f"{missing}; nor does one come with tandem: {error}") from None


def is_bundled(registry: Registry) -> bool:
    """Whether this is the registry that comes with the package."""
    return registry.root.resolve() == BUNDLED.resolve()
