"""Routes ``/v1/primitives`` and ``/v1/blobs``: the registry."""

from __future__ import annotations

import os
from contextlib import suppress
from functools import lru_cache
from typing import Annotated

from fastapi import APIRouter, Query, Request, Response
from fastapi import Path as InPath

from service.base.errors import RegistryError, StorageError
from service.base.parsing import NAME
from service.registry.bundled import BUNDLED, find_version, is_bundled
from service.registry.manifest import Manifest
from service.registry.names import Version
from service.registry.registry import Registry
from service.status.files import BYTES, PARTS, file_response
from service.status.problems import INVALID, READ_ONLY, ProblemError, problems
from service.status.schemas import (
    AliasChange,
    AliasState,
    ManifestDocument,
    Origin,
    PrimitiveList,
    PrimitiveSummary,
    PrimitiveVersions,
    VersionSummary,
)

MAX_VERIFIED = 4096
_FOREVER = "private, max-age=31536000, immutable"
_Name = Annotated[str, InPath(pattern=f"^{NAME}$", examples=["panda-cube"])]
_Alias = Annotated[str, InPath(pattern=r"^([a-z]|[0-9]+[a-z._-])[a-z0-9._-]*$", max_length=64, examples=["champion"])]
_Version = Annotated[str, InPath(pattern=f"^{NAME}$", description="a number or an alias", examples=["champion"])]
_Digest = Annotated[str, InPath(pattern=r"^[0-9a-f]{64}$", description="a manifest's `blob_sha256`")]
_UNKNOWN = (404, "There is no such name, version or alias.")


def primitives_router(registry: Registry) -> APIRouter:
    """Make the routes about frozen primitives: those of ``registry``, and beside them those that come with tandem.

    Where both have a version of one name and number, that of ``registry`` counts, as when primitives are loaded.
    """
    router = APIRouter(prefix="/v1", tags=["primitives"])
    shelf = Shelf(registry)

    @lru_cache(MAX_VERIFIED)
    def verify(place: Registry, digest: str, *_stamp: int) -> None:
        # once for each state of the file: clients cache blobs for ever, so a damaged one must never be served
        place.get_blob(digest)

    @router.get("/primitives", summary="All names")
    def list_primitives() -> PrimitiveList:
        """Sorted; those that come with tandem are always there."""
        return PrimitiveList(primitives=tuple(shelf.summary(name) for name in shelf.names()))

    @router.get("/primitives/{name}", summary="The versions of a name", responses=problems(_UNKNOWN, INVALID))
    def get_primitive(name: _Name, limit: Annotated[int, Query(ge=1, le=1000)] = 50) -> PrimitiveVersions:
        """Newest first, each with where it is, and the aliases."""
        if name not in shelf.names():
            registry.resolve(f"{name}@1")  # raises the error that says which names there are
        return PrimitiveVersions(**dict(shelf.summary(name)), versions=shelf.versions(name, limit))

    @router.get(
        "/primitives/{name}/versions/{version}",
        summary="The manifest of a version",
        response_class=Response,
        response_model=None,
        responses={200: {"model": ManifestDocument, "description": "As published."}, **problems(_UNKNOWN, INVALID)},
    )
    def get_version(name: _Name, version: _Version) -> Response:
        """The manifest; `/v1/blobs/sha256/{blob_sha256}` has the parameters, safetensors bytes."""
        place, found = find_version(f"{name}@{version}", registry.root)
        return Response(place.manifest(str(found)).to_bytes(), media_type="application/json")

    @router.get(
        "/blobs/sha256/{digest}",
        summary="Parameters",
        response_class=Response,
        responses={
            200: {"description": "safetensors bytes.", "content": {"application/octet-stream": BYTES}},
            **PARTS,
            **problems((404, "There is no such blob."), INVALID),
        },
    )
    def get_blob(request: Request, digest: _Digest) -> Response:
        """Checked against the digest, which is also the entity tag; a blob never changes."""
        for place in reversed(shelf.registries.values()):
            path = place.blob_path(digest)
            try:
                status = os.stat(path)
            except FileNotFoundError:
                continue
            verify(place, digest, status.st_mtime_ns, status.st_size, status.st_ino)
            return file_response(request, path, "application/octet-stream", etag=digest, cache=_FOREVER)
        raise ProblemError(404, "unknown-blob", f"no blob {digest} here; a manifest names the ones there are")

    @router.put(
        "/primitives/{name}/aliases/{alias}",
        summary="Make or move an alias",
        responses=problems(READ_ONLY, _UNKNOWN, INVALID, (409, "This registry is read-only.")),
    )
    def put_alias(name: _Name, alias: _Alias, change: AliasChange) -> AliasState:
        """The alias may move to any version, newer or older."""
        try:
            registry.check_writable()
        except RegistryError as error:
            raise ProblemError(409, "read-only", str(error)) from None
        version = registry.set_alias(name, alias, change.version)
        return AliasState(name=name, alias=alias, version=version.number)

    return router


class Shelf:
    """Reads two registries as one, as `find_version` does: what the user's has hides the same of the package's."""

    def __init__(self, registry: Registry) -> None:
        self.registries: dict[Origin, Registry] = {"bundled": Registry(BUNDLED), "registry": registry}
        """The one that counts is the last, as of equal keys in a dictionary."""
        if is_bundled(registry):
            del self.registries["bundled"]

    def names(self) -> list[str]:
        """Every name that has a version, sorted."""
        return sorted({name for registry in self.registries.values() for name in registry.names()})

    def summary(self, name: str) -> PrimitiveSummary:
        """What there is of a name that has a version."""
        origins, aliases = self._origins(name), dict[str, tuple[Origin, int]]()
        with suppress(StorageError, OSError):  # a damaged alias must not hide the name; the name's own page says so
            aliases = self._aliases(name)
        return PrimitiveSummary(
            name=name,
            num_versions=len(origins),
            newest=max(origins),
            aliases={alias: number for alias, (_, number) in sorted(aliases.items())},
            origins=tuple(origin for origin in reversed(self.registries) if self._versions(origin, name)),
        )

    def versions(self, name: str, limit: int) -> tuple[VersionSummary, ...]:
        """The newest versions of a name, the newest first."""
        aliases = self._aliases(name)
        return tuple(
            self._describe(
                origin, Version(name, number), [each for each in aliases if aliases[each] == (origin, number)]
            )
            for number, origin in sorted(self._origins(name).items(), reverse=True)[:limit]
        )

    def _origins(self, name: str) -> dict[int, Origin]:
        """Where each version is."""
        return {version.number: origin for origin in self.registries for version in self._versions(origin, name)}

    def _versions(self, origin: Origin, name: str) -> list[Version]:
        """The versions of a name in one of the registries; none where they may not be read, as of another user."""
        try:
            return self.registries[origin].versions(name)
        except PermissionError:
            return []

    def _aliases(self, name: str) -> dict[str, tuple[Origin, int]]:
        """Where the version of each alias is, and its number."""
        found = dict[str, tuple[Origin, int]]()
        for origin, registry in self.registries.items():
            with suppress(PermissionError):
                found |= {alias: (origin, number) for alias, number in registry.aliases(name).items()}
        return found

    def _describe(self, origin: Origin, version: Version, aliases: list[str]) -> VersionSummary:
        registry = self.registries[origin]
        try:
            manifest = registry.manifest(str(version))
            said = manifest.model_dump(include=set(VersionSummary.model_fields) - {"version"}) | _lineage(manifest)
        except StorageError as error:  # must not hide the other versions
            said = {"problem": str(error)}
        place = {"version": version.number, "origin": origin, "directory": str(registry.root)}
        return VersionSummary.model_validate({**place, "aliases": aliases, **said})


def _lineage(manifest: Manifest) -> dict[str, str | None]:
    """What a manifest says of where its version comes from; fields that it may have or not, whatever its kind."""
    spaces = manifest.spaces

    def text(*values: object) -> str | None:
        return next((value for value in values if isinstance(value, str) and value), None)

    return {
        "kind": text(spaces.get("kind")) or "primitives",
        "task": text(spaces.get("task")),
        "primitives": text(spaces.get("primitives"), manifest.config.get("primitives")),
    }
