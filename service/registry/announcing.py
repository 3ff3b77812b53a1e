"""Who is told when a registry changes. The files are the truth: who is told may be away, and nothing fails for it."""

from __future__ import annotations

import functools
import logging
import os
from typing import TYPE_CHECKING, Protocol

from service.errors import TandemError

if TYPE_CHECKING:
    from service.registry.names import Version
    from service.registry.registry import Registry

_logger = logging.getLogger(__name__)


class Listener(Protocol):
    """Is told after the files were written; no method may raise."""

    def published(self, registry: Registry, version: Version) -> None:
        """A version was published, and aliases of its name may have moved to it."""

    def alias_moved(self, registry: Registry, version: Version, alias: str) -> None:
        """``alias`` means ``version`` now."""


def default_listener() -> Listener | None:
    """The index in the Redis of ``TANDEM_REDIS_URL``; None where that is not set, or of no use, with a warning."""
    return _listener(os.environ.get("TANDEM_REDIS_URL", "").strip())


@functools.cache
def _listener(url: str) -> Listener | None:
    if not url:
        return None
    try:
        from service.store.address import RedisAddress

        address = RedisAddress(url)  # says so where the package redis is missing
        from service.store.registry_index import RegistryIndex

        return RegistryIndex(address)
    except (ImportError, TandemError) as error:  # a registry works without
        _logger.warning("the registry's index is not kept up to date: %s", error)
        return None
