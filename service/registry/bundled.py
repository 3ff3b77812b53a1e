"""The look-up of a reference: in the user's registry, and among the primitives that come with the package.

What ``Registry.export`` wrote is looked up, too, as a registry of that one version.
"""

from __future__ import annotations

from pathlib import Path

from service.base.errors import UnknownVersionError, did_you_mean
from service.registry.manifest import read_manifest
from service.registry.names import Version, is_service, split_reference
from service.registry.registry import EXPORTED_MANIFEST, EXPORTED_PARAMETERS, Registry

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
        missing = str(error)
    try:
        return bundled, bundled.resolve(reference)
    except UnknownVersionError as error:
        if bundled.versions(name):
            raise UnknownVersionError(f"{missing}; nor does one come with tandem: {error}") from None
        if own.versions(name):
            raise UnknownVersionError(missing) from None
        hint = did_you_mean(name, [*own.names(), *bundled.names()])
        raise UnknownVersionError(f"{missing}; with tandem comes: {', '.join(bundled.names())}{hint}") from None


def is_bundled(registry: Registry) -> bool:
    """Whether this is the registry that comes with the package."""
    return registry.root.resolve() == BUNDLED.resolve()


def is_exported(path: Path) -> bool:
    """Whether a directory holds an exported version."""
    return (path / EXPORTED_MANIFEST).exists()


class ExportedVersion(Registry):
    """The version in a directory, under the name and number that it has in the registry it comes from.

    It is found by its reference, and in no list: aliases are not exported.

    Args:
        root: the directory.

    Raises:
        StorageError: its manifest is damaged, or cannot be read.
    """

    is_only_read = True

    def __init__(self, root: Path) -> None:
        super().__init__(root)
        self._file = root / EXPORTED_MANIFEST
        manifest = read_manifest(self._file)
        self.version = Version(manifest.name, manifest.version)

    def _manifest_path(self, version: Version) -> Path:
        return self._file if version == self.version else super()._manifest_path(version)

    def blob_path(self, digest: str) -> Path:
        """Its one file of parameters; what reads them checks their digest all the same."""
        return self.root / EXPORTED_PARAMETERS
