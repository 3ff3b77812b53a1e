"""The registry: immutable versions of named parameters, with movable aliases, in plain files.

Layout under the root::

    blobs/sha256/<digest>         safetensors bytes
    models/<name>/versions/<n>    manifest, JSON; made exclusively, never changed
    models/<name>/aliases/<a>     the number of a version; moved by replacing the file

    READ_ONLY                     is there where nothing may be published

A publish writes the blob, then the manifest, then the aliases, each atomically: a reader sees all of a version or none.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Iterable, Mapping
from datetime import UTC, datetime
from io import FileIO
from pathlib import Path
from typing import Any

import numpy as np

from service.base import tensors
from service.base.errors import DamagedBlobError, RegistryError, StorageError, UnknownVersionError, did_you_mean
from service.base.files import open_to_append, os_errors, read_regular, write_atomic, write_exclusive
from service.base.lock import LOCK_FILE, WITHOUT_LOCKS, take
from service.base.version import git_commit
from service.registry import names
from service.registry.manifest import Manifest, make_manifest, read_manifest
from service.registry.names import LATEST, Version

MAX_ALIAS_BYTES = 100
"""Of an alias' file, which holds a number."""
MAX_BLOB_BYTES = 1024**3
"""The largest primitives there are have about a megabyte."""
_WAIT_S = 5.0
"""For another process that moves an alias, which takes milliseconds."""
READ_ONLY_FILE = "READ_ONLY"
EXPORTED_MANIFEST, EXPORTED_PARAMETERS = "manifest.json", "primitives.safetensors"
"""Files of an exported version."""
Check = Callable[[Manifest, Mapping[str, np.ndarray]], Iterable[str]]
"""Tells in a line each what is wrong with a manifest and its arrays."""
_MEND = "restore the file from a copy, or publish the same parameters again"


class Registry:
    """Named, versioned parameters in the directory ``root``; any number of processes may publish and read at once."""

    is_only_read = False
    """Whether it is, also without the file that marks one."""

    def __init__(self, root: Path) -> None:
        self.root = root

    def check_writable(self, name: str | None = None) -> None:
        """Check that this registry may be written, and versions of a name.

        Raises:
            RegistryError: it is marked as only read, as the one that comes with tandem is; or it cannot be written.
        """
        root = self.root.absolute()
        there = next(path for path in (root, *root.parents) if os.path.exists(path))
        of_others = [root / "models", self.blob_path("0" * 64).parent]  # where several users publish
        of_others += [] if name is None else [self._directory(name) / part for part in ("versions", "aliases")]
        for path in (there, *filter(os.path.exists, of_others)):
            if not path.is_dir() or not os.access(path, os.W_OK | os.X_OK):
                what = "is not writable" if path.is_dir() else "is no directory"
                raise RegistryError(f"cannot write {self.root}: {path} {what}; name another with --registry")
        lock = None if name is None else self._alias_directory(name) / LOCK_FILE
        if lock is not None and os.path.exists(lock) and not os.access(lock, os.W_OK):  # who published first made it
            raise RegistryError(
                f"cannot write {self.root}: {lock} is not writable; let its owner do chmod a+w, or name another "
                "registry with --registry"
            )
        # a file: it is found through whatever path leads to the directory
        if self.is_only_read or (self.root / READ_ONLY_FILE).exists():
            raise RegistryError(
                f"cannot write {self.root}: this registry is only read; "
                "name another directory with --registry or TANDEM_REGISTRY"
            )

    def publish(
        self,
        name: str,
        parameters: Mapping[str, np.ndarray],
        *,
        spaces: Mapping[str, Any],
        normalisation: Mapping[str, Any],
        config: Mapping[str, Any],
        metrics: Mapping[str, float],
        parent: Version | None = None,
        history: Mapping[str, Any] | None = None,
    ) -> Version:
        """Make the next version of ``name`` and move ``latest`` to it.

        Of two publishers at the same time, the later version keeps the alias.

        Args:
            name: such as ``panda-cube``.
            parameters: arrays by name; see `tensors.encode` for what they may be.
            spaces: action and observation spaces, plain JSON values.
            normalisation: the network's fixed input normalisation, plain JSON values.
            config: configuration of the run, plain JSON values.
            metrics: finite numbers.
            parent: the version this one was trained on from.
            history: of the run, where not all went as it was begun; plain JSON values.

        Raises:
            RegistryError: a bad name, array or value, or a registry that is only read; nothing is written.
            StorageError: the disk cannot be written; what was there before is intact.
        """
        self.check_writable()
        names.check_name(name)
        fields: dict[str, Any] = {
            "name": name,
            "created": datetime.now(UTC).isoformat(timespec="seconds"),
            "tensors": {
                name: {"shape": list(array.shape), "dtype": array.dtype.name}
                for name, array in sorted(parameters.items())
            },
            "spaces": dict(spaces),
            "normalisation": dict(normalisation),
            "config": dict(config),
            "metrics": dict(metrics),
            "parent": str(parent) if parent is not None else None,
            "history": dict(history) if history is not None else None,
            "git_commit": git_commit(),
        }
        version = self._publish_version(name, parameters, fields)
        self.complete(version)
        return version

    def complete(self, version: Version) -> None:
        """End the publishing of a version that is there: move ``latest`` forward to it.

        Raises:
            RegistryError: the alias is damaged.
            StorageError: the disk cannot be written.
        """
        self._move_alias(version.name, LATEST, version.number, back=False)

    def resolve(self, reference: str) -> Version:
        """The version that ``NAME``, ``NAME@VERSION`` or ``NAME@ALIAS`` means now; ``NAME`` is ``NAME@latest``.

        Raises:
            UnknownVersionError: there is none; the message lists what there is.
            RegistryError: not a reference, or a damaged alias.
        """
        name, target = names.split_reference(reference)
        number = target if isinstance(target, int) else self._read_alias(name, target)
        path = None if number is None else self._manifest_path(Version(name, number))
        with os_errors("read", self.root / "models" / name):
            if number is None or path is None or not path.exists():
                raise UnknownVersionError(self._describe_missing(name, target))
        return Version(name, number)

    def manifest(self, reference: str) -> Manifest:
        """The verified manifest of a version.

        Raises:
            UnknownVersionError: no such version.
            DamagedBlobError: the manifest is damaged.
            FormatVersionError: the manifest is of another format.
        """
        return read_manifest(self._manifest_path(self.resolve(reference)))

    def load(self, reference: str) -> tuple[Manifest, dict[str, np.ndarray]]:
        """The verified manifest and parameters of a version.

        Raises:
            StorageError: as for `manifest`; DamagedBlobError also for damaged parameters.
        """
        manifest = self.manifest(reference)
        return manifest, tensors.decode(self.get_blob(manifest.blob_sha256))

    def names(self) -> list[str]:
        """Every name that has a version, sorted, without those that may not be read, as of another user.

        Raises:
            RegistryError: something else than a directory is at the registry's path.
        """
        return [name for name in self._all_names() if self._has_versions(name)]

    def ready(self) -> None:
        """Find out whether names can be read.

        Raises:
            RegistryError: something else than a directory is at the registry's path.
            OSError: they cannot.
        """
        self._all_names()

    def _all_names(self) -> list[str]:
        """Every name that has a directory, sorted."""
        if self.root.exists() and not self.root.is_dir():
            raise RegistryError(
                f"{self.root} is no directory, as a registry is; name one with --registry or TANDEM_REGISTRY"
            )
        directory = self.root / "models"
        found = [entry.name for entry in directory.iterdir()] if directory.is_dir() else []
        return sorted(filter(names.is_name, found))

    def _has_versions(self, name: str) -> bool:
        try:
            return bool(self.versions(name))
        except PermissionError:
            return False

    def versions(self, name: str) -> list[Version]:
        """The versions of ``name``, oldest first; empty when there are none."""
        directory = self._directory(name) / "versions"
        found = [entry.name for entry in directory.iterdir()] if directory.is_dir() else []
        return [Version(name, number) for number in sorted(int(text) for text in found if names.is_number(text))]

    def aliases(self, name: str) -> dict[str, int]:
        """Aliases of ``name`` and the number each means, sorted.

        Raises:
            RegistryError: an alias file is damaged.
        """
        directory = self._alias_directory(name)
        found = sorted(entry.name for entry in directory.iterdir()) if directory.is_dir() else []
        numbers = {alias: self._read_alias(name, alias) for alias in found if names.is_name(alias)}
        return {alias: number for alias, number in numbers.items() if number is not None}

    def set_alias(self, name: str, alias: str, version: int) -> Version:
        """Make or move ``alias`` of ``name`` to ``version``, forward or back.

        Raises:
            RegistryError: a bad name or alias, or a registry that is only read.
            UnknownVersionError: no such version.
            StorageError: the disk cannot be written.
        """
        self.check_writable()
        target = self.resolve(f"{name}@{version}")
        self._move_alias(name, alias, version)
        return target

    def verify(self, reference: str | None = None, check: Check = lambda manifest, arrays: []) -> list[str]:
        """Read a version, or everything, and check each byte.

        Args:
            reference: of the version; None for everything.
            check: tells what else is wrong with a manifest and its arrays, a line each.

        Returns:
            one line for each problem; empty when all is well.

        Raises:
            UnknownVersionError: no such version.
        """
        if reference is not None:
            return self._problems_of(self.resolve(reference), check)
        problems = list[str]()
        for name in self._all_names():
            try:
                versions = self.versions(name)
                problems += [problem for version in versions for problem in self._problems_of(version, check)]
                problems += self._alias_problems(name) if versions else []
            except OSError as error:
                problems.append(f"{name}: cannot read {error.filename}: {error.strerror}; check its permissions")
        return problems

    def export(self, reference: str, directory: Path) -> Manifest:
        """Write a version into ``directory``: ``primitives.safetensors`` and ``manifest.json``, which need no registry.

        Raises:
            UnknownVersionError: no such version.
            DamagedBlobError: the version is damaged; nothing is written.
            RegistryError: the directory holds an export already.
            StorageError: it cannot be written.
        """
        manifest, _ = self.load(reference)
        files = {
            directory / EXPORTED_PARAMETERS: self.get_blob(manifest.blob_sha256),
            directory / EXPORTED_MANIFEST: manifest.to_bytes(),
        }
        for path in files:
            if path.exists():
                raise RegistryError(f"cannot export {manifest.reference}: {path} exists; choose another directory")
        for path, data in files.items():
            write_atomic(path, data)
        return manifest

    def blob_path(self, digest: str) -> Path:
        """File of the bytes of that sha256 in hex, there or not."""
        return self.root / "blobs" / "sha256" / digest

    def put_blob(self, data: bytes) -> str:
        """Store bytes and return their sha256 in hex; what is already there and whole is not written again.

        Raises:
            StorageError: the disk is full or cannot be written; nothing is left behind.
        """
        digest = sha256_of(data)
        try:
            self.get_blob(digest)
        except DamagedBlobError:  # or not there yet
            write_atomic(self.blob_path(digest), data)
        return digest

    def get_blob(self, digest: str) -> bytes:
        """The bytes of that sha256 in hex, verified.

        Raises:
            DamagedBlobError: the file is missing or holds other bytes.
            StorageError: the file cannot be read.
        """
        path = self.blob_path(digest)
        with os_errors("read", path):
            try:
                data = read_regular(path, MAX_BLOB_BYTES, follow=True)
            except FileNotFoundError:
                raise DamagedBlobError(f"blob {path} is missing; {_MEND}") from None
        check_digest(path, data, digest)
        return data

    def _publish_version(self, name: str, parameters: Mapping[str, np.ndarray], fields: dict[str, Any]) -> Version:
        try:
            data = tensors.encode(parameters)
        except ValueError as error:
            raise RegistryError(f"cannot publish {name}: {error}") from None
        fields |= {"blob_sha256": sha256_of(data), "blob_bytes": len(data)}
        make_manifest({**fields, "version": 1})  # a bad value must be found before anything is written
        self.put_blob(data)
        while True:
            # unique: only one writer makes number n; contiguous: no writer tries n + 1 before n is there
            version = Version(name, max((last.number for last in self.versions(name)), default=0) + 1)
            path = self._manifest_path(version)
            if write_exclusive(path, make_manifest({**fields, "version": version.number}).to_bytes()):
                return version

    def _read_alias(self, name: str, alias: str) -> int | None:
        """The number ``alias`` means; None when there is no such alias."""
        path = self._alias_directory(name) / names.check_alias(alias)
        with os_errors("read", path):
            try:
                text = read_regular(path, MAX_ALIAS_BYTES, follow=True).decode("ascii", errors="replace").strip()
            except FileNotFoundError:
                return None
        if not names.is_number(text):
            raise RegistryError(f"alias {path} is damaged: it holds {text!r}; set it again with tandem registry alias")
        return int(text)

    def _move_alias(self, name: str, alias: str, number: int, *, back: bool = True) -> None:
        """Make ``alias`` mean the version ``number``; any number of processes may do so at once.

        Without ``back``, an alias of a greater number stays: a slow publisher cannot undo a later one.
        """
        directory = self._alias_directory(name)
        path = directory / names.check_alias(alias)
        with os_errors("write", path):
            directory.mkdir(parents=True, exist_ok=True)
            with open_to_append(directory / LOCK_FILE) as lock:
                self._wait_for(lock, directory / LOCK_FILE)
                if back or (self._read_alias(name, alias) or 0) < number:
                    write_atomic(path, f"{number}\n".encode())

    def _wait_for(self, lock: FileIO, path: Path) -> None:
        try:
            taken = take(lock, path, _WAIT_S)
        except OSError as error:
            raise StorageError(
                f"{path}: its file system has no locks ({error.strerror}); use another registry, or see to it that one "
                f"process at a time publishes and set {WITHOUT_LOCKS}=1"
            ) from None
        if not taken:
            raise StorageError(f"another process has held {path} for {_WAIT_S:g} s; end it, or try again")

    def _problems_of(self, version: Version, check: Check) -> list[str]:
        try:
            manifest, arrays = self.load(str(version))
        except StorageError as error:
            return [f"{version}: {error}"]
        if (manifest.name, manifest.version) != version:
            return [f"{version}: its manifest is that of {manifest.reference}; restore the file from a copy"]
        return [f"{version}: {problem}" for problem in check(manifest, arrays)]

    def _alias_problems(self, name: str) -> list[str]:
        numbers = {version.number for version in self.versions(name)}
        try:
            aliases = self.aliases(name)
        except StorageError as error:
            return [f"{name}: {error}"]
        return [
            f"{name}@{alias}: means version {number}, which is missing; move it with tandem registry alias"
            for alias, number in aliases.items()
            if number not in numbers
        ]

    def _describe_missing(self, name: str, target: int | str) -> str:
        versions = self.versions(name)
        if not versions:
            known = ", ".join(self.names())
            return f"no {name!r} in the registry {self.root}; " + (
                f"it holds: {known}; name one of those, or another registry" if known else "nothing is published there"
            )
        there = self.aliases(name)
        aliases = ", ".join(f"{alias} -> {number}" for alias, number in there.items()) or "none"
        kind = "version" if isinstance(target, int) else "alias"
        hint = did_you_mean(target, there) if isinstance(target, str) else ""
        span = f"{versions[0].number} to {versions[-1].number}"
        return (
            f"{name} has no {kind} {target!r} in the registry {self.root}; versions: {span}; aliases: {aliases}{hint}"
        )

    def _directory(self, name: str) -> Path:
        return self.root / "models" / names.check_name(name)

    def _manifest_path(self, version: Version) -> Path:
        return self._directory(version.name) / "versions" / str(version.number)

    def _alias_directory(self, name: str) -> Path:
        return self._directory(name) / "aliases"


def check_digest(place: Path | str, data: bytes, digest: str) -> None:
    """Check that the bytes read from ``place`` are those of ``digest``.

    Raises:
        DamagedBlobError: they are not.
    """
    if (actual := sha256_of(data)) != digest:
        raise DamagedBlobError(f"{place} is damaged: expected sha256 {digest}, it has {actual}; {_MEND}")


def sha256_of(data: bytes) -> str:
    """The sha256 of ``data`` in hex."""
    return hashlib.sha256(data).hexdigest()
