"""A version as two files that need no registry."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from service.io import tensors
from service.io.files import os_errors, write_atomic
from service.registry.blobs import check_digest
from service.registry.errors import RegistryError
from service.registry.manifest import Manifest, parse_manifest

PARAMETERS_FILE = "primitives.safetensors"
MANIFEST_FILE = "manifest.json"


def write_exported(directory: Path, manifest: Manifest, data: bytes) -> None:
    """Write ``primitives.safetensors`` and ``manifest.json`` into ``directory``, made when missing.

    Args:
        directory: must hold neither file.
        manifest: of the version.
        data: its safetensors bytes.

    Raises:
        RegistryError: a file is there already.
        StorageError: the directory cannot be written.
    """
    for path in (directory / PARAMETERS_FILE, directory / MANIFEST_FILE):
        if path.exists():
            raise RegistryError(f"cannot export {manifest.reference}: {path} exists; choose another directory")
    with os_errors("write", directory / PARAMETERS_FILE):
        write_atomic(directory / PARAMETERS_FILE, data)
        write_atomic(directory / MANIFEST_FILE, manifest.to_bytes())


def load_exported(directory: Path) -> tuple[Manifest, dict[str, np.ndarray]]:
    """The verified manifest and parameters that `Registry.export` wrote.

    Raises:
        RegistryError: no export there.
        DamagedBlobError: it is damaged.
        FormatVersionError: it is of another format.
    """
    manifest = parse_manifest(_read(directory / MANIFEST_FILE), directory / MANIFEST_FILE)
    data = _read(directory / PARAMETERS_FILE)
    check_digest(directory / PARAMETERS_FILE, data, manifest.blob_sha256)
    return manifest, tensors.decode(data)


def _read(path: Path) -> bytes:
    with os_errors("read", path):
        try:
            return path.read_bytes()
        except (FileNotFoundError, NotADirectoryError):
            raise RegistryError(f"no {path}; give a directory that tandem registry export wrote") from None
