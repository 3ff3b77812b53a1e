"""What ``Registry.export`` wrote, as a registry of that one version, which is only read."""

from __future__ import annotations

from pathlib import Path

from service.base.files import os_errors, read_regular
from service.registry.blobs import BlobStore
from service.registry.manifest import MAX_BYTES, parse_manifest
from service.registry.names import Version
from service.registry.registry import EXPORTED_MANIFEST, EXPORTED_PARAMETERS, Registry


def is_exported(path: Path) -> bool:
    """Whether a directory holds an exported version."""
    return (path / EXPORTED_MANIFEST).exists()


class ExportedVersion(Registry):
    """The version in a directory, under the name and number that it has in the registry it comes from.

    Args:
        root: the directory.

    Raises:
        StorageError: its manifest is damaged, or cannot be read.
    """

    def __init__(self, root: Path) -> None:
        super().__init__(root)
        self._file = root / EXPORTED_MANIFEST
        with os_errors("read", self._file):
            data = read_regular(self._file, MAX_BYTES, follow=True)
        manifest = parse_manifest(data, self._file)
        self.version = Version(manifest.name, manifest.version)
        self._blobs = _OneBlob(root)

    def check_writable(self) -> None:
        """Refuse: see ``Registry.check_writable``."""
        raise self.only_read()

    def names(self) -> list[str]:
        """The version's name."""
        return [self.version.name]

    def versions(self, name: str) -> list[Version]:
        """The version, if that is its name."""
        return [self.version] if name == self.version.name else []

    def aliases(self, name: str) -> dict[str, int]:
        """None: aliases are not exported."""
        return {}

    def _manifest_path(self, version: Version) -> Path:
        return self._file if version == self.version else super()._manifest_path(version)


class _OneBlob(BlobStore):
    """Parameters in a file with a name of its own; what reads them checks their digest all the same."""

    def path(self, digest: str) -> Path:
        return self._directory / EXPORTED_PARAMETERS
