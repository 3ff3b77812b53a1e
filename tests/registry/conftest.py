"""A full disk, and parameters to publish."""

import errno
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from service.registry.names import Version
from service.registry.registry import Registry
from tests.registry.helpers import Publish


@pytest.fixture
def registry(tmp_path: Path) -> Registry:
    """An empty registry."""
    return Registry(tmp_path / "registry")


@pytest.fixture
def publish(registry: Registry) -> Publish:
    """Publish one small version; keyword arguments replace the defaults."""

    def _publish(name: str = "panda-cube", value: float = 0.0, **changes: Any) -> Version:
        fields: dict[str, Any] = {
            "spaces": {"action": {"shape": [4], "low": -1.0, "high": 1.0}},
            "normalisation": {"mean": [0.0, 0.5], "scale": [1.0, 2.0]},
            "config": {"seed": 3, "world": {"object": "cube"}},
            "metrics": {"bob/success_rate": 0.5},
        }
        return registry.publish(name, {"gate.weight": np.full((2, 3), value, np.float32)}, **(fields | changes))

    return _publish


@pytest.fixture
def full_disk(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], None]:
    """Call with "write" or "fsync": from then on that call finds the disk full; a write first stores half its bytes."""
    real_write = os.write

    def _write(descriptor: int, data: memoryview) -> int:
        if len(data) > 1:
            return real_write(descriptor, data[: len(data) // 2])
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    def _fsync(descriptor: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    def _fill(call: str) -> None:
        monkeypatch.setattr(os, call, {"write": _write, "fsync": _fsync}[call])

    return _fill
