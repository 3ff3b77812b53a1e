"""The primitives that can be loaded: those of a registry, and beside them those that come with tandem."""

from __future__ import annotations

from service.base.errors import DamagedBlobError, FormatVersionError
from service.registry.bundled import BUNDLED, is_bundled
from service.registry.manifest import Manifest
from service.registry.names import Version
from service.registry.registry import Registry
from service.status.schemas import Origin, PrimitiveSummary, VersionSummary

_KIND = "primitives"


class Shelf:
    """Reads two registries as one, as `find_version` does: what the first one has hides the same of the second."""

    def __init__(self, registry: Registry) -> None:
        self.registries: dict[Origin, Registry] = {"registry": registry}
        if not is_bundled(registry):
            self.registries["bundled"] = Registry(BUNDLED)

    def names(self) -> list[str]:
        """Every name that has a version, sorted."""
        return sorted({name for registry in self.registries.values() for name in registry.names()})

    def summary(self, name: str) -> PrimitiveSummary:
        """What there is of a name that has a version."""
        numbers = [version.number for _, version in self._versions(name)]
        aliases = {alias: version.number for alias, (_, version) in self._aliases(name).items()}
        there = tuple(origin for origin, registry in self.registries.items() if registry.versions(name))
        return PrimitiveSummary(
            name=name,
            num_versions=len(numbers),
            newest=max(numbers),
            aliases=dict(sorted(aliases.items())),
            origins=there,
        )

    def versions(self, name: str) -> tuple[VersionSummary, ...]:
        """The versions of a name, newest first."""
        aliases = self._aliases(name)
        found = sorted(self._versions(name), key=lambda each: each[1].number, reverse=True)
        return tuple(
            self._describe(origin, version, [alias for alias, means in aliases.items() if means == (origin, version)])
            for origin, version in found
        )

    def _last_first(self) -> list[tuple[Origin, Registry]]:
        """The registries, so that in a dictionary the first one's entry is put last and counts."""
        return list(reversed(self.registries.items()))

    def _versions(self, name: str) -> list[tuple[Origin, Version]]:
        found = {
            version.number: (origin, version)
            for origin, registry in self._last_first()
            for version in registry.versions(name)
        }
        return list(found.values())

    def _aliases(self, name: str) -> dict[str, tuple[Origin, Version]]:
        return {
            alias: (origin, Version(name, number))
            for origin, registry in self._last_first()
            for alias, number in registry.aliases(name).items()
        }

    def _describe(self, origin: Origin, version: Version, aliases: list[str]) -> VersionSummary:
        registry = self.registries[origin]
        place: dict[str, object] = {
            "version": version.number,
            "aliases": tuple(aliases),
            "origin": origin,
            "directory": str(registry.root),
        }
        try:
            manifest = registry.manifest(str(version))
        except (DamagedBlobError, FormatVersionError) as error:  # must not hide the other versions
            return VersionSummary.model_validate({**place, "problem": str(error)})
        shown = manifest.model_dump(include=set(VersionSummary.model_fields) - {"version"})
        return VersionSummary.model_validate({**place, **shown, **_lineage(manifest)})


def _lineage(manifest: Manifest) -> dict[str, str | None]:
    """What a manifest says of where its version comes from; fields that it may have or not, whatever its kind."""
    own = manifest.model_dump(exclude={"tensors", "config"})
    spaces = manifest.spaces

    def text(*values: object) -> str | None:
        return next((value for value in values if isinstance(value, str) and value), None)

    return {
        "kind": text(spaces.get("kind")) or _KIND,
        "task": text(spaces.get("task")),
        "primitives": text(own.get("primitives"), spaces.get("primitives"), manifest.config.get("primitives")),
        "run": text(own.get("run"), (manifest.history or {}).get("run")),
    }
