"""What a registry holds, in Redis: quick to look up, with a notice of every change.

All but the notices can be made again from the registry's files, which are the truth.
"""

from __future__ import annotations

import hashlib
import json
import logging
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError
from redis.exceptions import RedisError, WatchError

from service.registry.errors import RegistryError
from service.registry.manifest import Manifest
from service.registry.names import Version
from service.registry.registry import Registry
from service.store import keys
from service.store.address import RedisAddress, reason_of
from service.store.errors import DamagedStoreError, StoreUnavailableError

TIMEOUT_S = 0.5
"""Publishing waits no longer for a Redis that is away."""
_MAX_TRIES = 20
_ALIASES = TypeAdapter(dict[str, int])
_logger = logging.getLogger(__name__)


class IndexedVersion(BaseModel):
    """A version as the index knows it."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: str
    version: int = Field(ge=1)
    created: str = Field(description="UTC, ISO 8601")
    manifest_sha256: str = Field(description="of the manifest's bytes")
    blob_sha256: str
    blob_bytes: int = Field(ge=0)
    parent: str | None = None


@dataclass(frozen=True, slots=True)
class Notice:
    """A change of the registry."""

    id: str
    """Its place in the stream; notices after it are asked for with it."""
    event: Literal["published", "alias"]
    reference: str
    """``NAME@NUMBER``."""
    alias: str | None
    """That was moved to it."""


class RegistryIndex:
    """The index of any number of registries in one Redis; a ``Listener`` of each."""

    def __init__(self, address: RedisAddress) -> None:
        """Nothing is sent before the first call."""
        self._address = address
        self._client = address.client(TIMEOUT_S)

    # --- told by the registry -----------------------------------------------------------------------------------------

    def published(self, registry: Registry, version: Version) -> None:
        """Add a version, and all aliases of its name as they are now."""
        self._try_to_tell(registry, version, None)

    def alias_moved(self, registry: Registry, version: Version, alias: str) -> None:
        """Set all aliases of the version's name as they are now."""
        self._try_to_tell(registry, version, alias)

    def rebuild(self, registry: Registry) -> int:
        """Make the index anew from the registry's files; what cannot be read is left out with a warning.

        Returns:
            How many versions it has now.

        Raises:
            StoreUnavailableError: Redis is away; the index is as it was.
        """
        versions_key, aliases_key = _keys(registry.root)
        num_versions = 0

        def replace(pipe: Any) -> None:
            nonlocal num_versions
            entries = dict(_readable(registry))
            aliases = {name: json.dumps(_aliases(registry, name)) for name in registry.names()}
            num_versions = len(entries)
            pipe.multi()
            pipe.delete(versions_key, aliases_key)
            if entries:
                pipe.hset(versions_key, mapping=entries)
            if aliases:
                pipe.hset(aliases_key, mapping=aliases)

        with self._errors():
            self._transact(registry, replace)
        return num_versions

    # --- asked by others ----------------------------------------------------------------------------------------------

    def versions(self, root: Path) -> list[IndexedVersion]:
        """Every version of the registry in ``root``, by name and number.

        Raises:
            StoreUnavailableError: Redis is away.
            DamagedStoreError: the index holds something else; ``tandem registry reindex`` mends it.
        """
        with self._errors():
            texts = self._client.hgetall(_keys(root)[0]).values()
            found = [IndexedVersion.model_validate_json(text) for text in texts]
        return sorted(found, key=lambda each: (each.name, each.version))

    def aliases(self, root: Path, name: str) -> dict[str, int]:
        """Aliases of ``name`` and the number each means; see `versions` for errors."""
        with self._errors():
            text = self._client.hget(_keys(root)[1], name)
            return _ALIASES.validate_json(text) if text is not None else {}

    def notices(self, root: Path, *, after: str = "0", wait_s: float = 0.0) -> list[Notice]:
        """What changed after a notice's id, oldest first, at most 1,000; see `versions` for errors.

        Args:
            root: of the registry.
            after: ``"0"`` for everything that is remembered.
            wait_s: how long to wait for the first; empty when none came.
        """
        deadline_s = time.monotonic() + wait_s
        while True:
            with self._errors():  # no blocking read: it would have to outlast the socket's time-out
                entries = self._client.xrange(keys.registry(root, "published"), f"({after}", "+", count=1000)
                found = [_notice(identity, fields) for identity, fields in entries]
            left_s = deadline_s - time.monotonic()
            if found or left_s <= 0.0:
                return found
            time.sleep(min(0.2, left_s))

    # --- inside -------------------------------------------------------------------------------------------------------

    def _try_to_tell(self, registry: Registry, version: Version, alias: str | None) -> None:
        try:
            self._tell(registry, version, alias)
        except (RedisError, OSError) as error:
            reason = reason_of(error)
        except RegistryError as error:
            reason = str(error)
        else:
            return
        _logger.warning(
            "%s is in the registry, but not in its index in Redis at %s: %s; when that is well again: tandem registry "
            "reindex --registry %s",
            version if alias is None else f"{version.name}@{alias}",
            self._address,
            reason,
            registry.root,
        )

    def _tell(self, registry: Registry, version: Version, alias: str | None) -> None:
        versions_key, aliases_key = _keys(registry.root)
        entry = _entry(registry, version)

        def write(pipe: Any) -> None:
            # read under the watch: of two that move an alias at once, the one that comes last reads what is there
            aliases = json.dumps(registry.aliases(version.name))
            pipe.multi()
            pipe.hset(versions_key, str(version), entry)
            pipe.hset(aliases_key, version.name, aliases)
            notice = {"event": "published" if alias is None else "alias", "reference": str(version)}
            notice |= {"alias": alias} if alias is not None else {}
            notice |= {"time": datetime.now(UTC).isoformat(timespec="milliseconds")}
            pipe.xadd(keys.registry(registry.root, "published"), notice, maxlen=keys.MAX_NOTICES, approximate=True)

        self._transact(registry, write)

    def _transact(self, registry: Registry, fill: Callable[[Any], None]) -> None:
        """Let ``fill`` read files and begin a transaction, again and again until nobody changed the index meanwhile."""
        for _ in range(_MAX_TRIES):
            with self._client.pipeline() as pipe:
                pipe.watch(*_keys(registry.root))
                fill(pipe)
                try:
                    pipe.execute()
                except WatchError:
                    continue
                return
        raise WatchError("others change the index all the time")

    @contextmanager
    def _errors(self) -> Iterator[None]:
        try:
            yield
        except ValidationError:
            raise self._damaged("not what a registry wrote") from None
        except (RedisError, OSError) as error:
            if "WRONGTYPE" in str(error):
                raise self._damaged(reason_of(error)) from None
            unavailable: StoreUnavailableError = self._address.unavailable(error)
            raise unavailable from None

    def _damaged(self, what: str) -> DamagedStoreError:
        return DamagedStoreError(
            f"the registry's index in Redis at {self._address} is damaged: {what}; delete tandem:registry:* and run "
            "tandem registry reindex"
        )


def _keys(root: Path) -> tuple[str, str]:
    return keys.registry(root, "versions"), keys.registry(root, "aliases")


def _entry(registry: Registry, version: Version) -> str:
    manifest: Manifest = registry.manifest(str(version))
    return IndexedVersion(
        name=version.name,
        version=version.number,
        created=manifest.created,
        manifest_sha256=hashlib.sha256(manifest.to_bytes()).hexdigest(),
        blob_sha256=manifest.blob_sha256,
        blob_bytes=manifest.blob_bytes,
        parent=manifest.parent,
    ).model_dump_json()


def _readable(registry: Registry) -> Iterator[tuple[str, str]]:
    for version in (version for name in registry.names() for version in registry.versions(name)):
        try:
            yield str(version), _entry(registry, version)
        except RegistryError as error:
            _logger.warning("%s is left out of the index: %s", version, error)


def _aliases(registry: Registry, name: str) -> dict[str, int]:
    try:
        return registry.aliases(name)
    except RegistryError as error:
        _logger.warning("the aliases of %s are left out of the index: %s", name, error)
        return {}


def _notice(identity: bytes, fields: dict[bytes, bytes]) -> Notice:
    text = {key.decode(errors="replace"): value.decode(errors="replace") for key, value in fields.items()}
    return Notice(
        id=identity.decode(),
        event="alias" if text.get("event") == "alias" else "published",
        reference=text.get("reference", ""),
        alias=text.get("alias"),
    )
