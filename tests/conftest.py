"""Fixtures that several packages of tests use, and one thread per test process.

xdist keeps every core busy, and results do not depend on the thread count.
The variables have to be set before NumPy or torch is imported, so that happens here, at import.
"""

from __future__ import annotations

import errno
import functools
import gc
import os
import secrets
import signal
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
import typer.testing

if TYPE_CHECKING:
    from service.registry.loading import Trained
    from service.registry.names import Version
    from service.registry.registry import Registry
    from tests.registry.helpers import Publish

for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS"):
    os.environ[variable] = "1"
os.environ["MPLBACKEND"] = "agg"
# Ray reads these at import, too. With a token of our own it leaves none in the home directory.
os.environ |= {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": secrets.token_hex(32), "RAY_USAGE_STATS_ENABLED": "0"}
os.environ |= {"RAY_prestart_worker_first_driver": "0"}  # no spare workers, a second of a core each
# Else every call of CliRunner builds all commands anew: 30 ms, some thousand times.
typer.main.get_command = typer.testing._get_command = functools.cache(typer.main.get_command)
os.fsync = lambda descriptor: None  # no test pulls the plug, and a tiny run waits for the disk for a tenth of its time
gc.disable()  # while tests are imported; see pytest_collection_finish

TESTS = Path(__file__).parent
SLOW = (
    "cluster", "status/test_page.py", "benchmarks", "runs/test_study.py", "test_benchmarks.py", "media",
    "methods/test_task.py", "status/test_page_curves.py", "status/test_downstream.py", "runs/test_signals.py",
    "envs/test_world.py", "test_package.py", "test_notebooks.py", "robot/play/test_server.py", "runs/test_reporting.py",
    "methods/test_skill_learning.py", "runs/test_killed.py", "runs/test_pretrain.py", "export", "cli/test_main.py",
    "status/test_nginx.py", "status/test_stream.py", "status/test_connections.py", "cli/test_tasks.py",
    "status/test_openapi.py", "methods/test_skill_run.py", "test_docs_site.py", "cli/test_attacks.py",
    "store/test_redis.py", "status/test_client.py", "test_ship_primitives.py",
)  # fmt: skip
"""Where tests start Ray, a browser, a server or a training of their own; the longest first."""


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark slow tests, and begin with them: so no process has a long one left when the others have ended."""
    if missing := [each for each in SLOW if not (TESTS / each).exists()]:
        raise pytest.UsageError(f"tests/conftest.py names slow tests that are not there: {', '.join(missing)}")

    @functools.cache
    def place(path: Path) -> int:
        return next((index for index, each in enumerate(SLOW) if path.is_relative_to(TESTS / each)), len(SLOW))

    for item in items:
        if place(item.path) < len(SLOW):
            item.add_marker("slow")
    items.sort(key=lambda item: place(item.path))


def pytest_collection_finish() -> None:
    """Begin garbage collection, without what imports made: that took a tenth of the time of many tests."""
    gc.collect()
    gc.freeze()
    gc.enable()


@pytest.fixture
def default_signals() -> Iterator[None]:
    """Signals as a program in the foreground has them: in the background a shell takes SIGINT away, ``nohup`` SIGHUP.

    Processes that a test starts have them like that, too.
    """
    defaults = {
        signal.SIGINT: signal.default_int_handler,
        signal.SIGTERM: signal.SIG_DFL,
        signal.SIGHUP: signal.SIG_DFL,
    }
    before = {number: signal.signal(number, handler) for number, handler in defaults.items()}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.fixture
def no_artifacts(monkeypatch: pytest.MonkeyPatch) -> None:
    """Trainings of this process end without curves and films, which take up to half a minute."""
    monkeypatch.setattr("service.runs.train.make_artifacts", lambda *arguments: {})


@pytest.fixture
def registry(tmp_path: Path) -> Registry:
    """An empty registry."""
    from service.registry.registry import Registry

    return Registry(tmp_path / "registry")


@pytest.fixture
def publish(registry: Registry) -> Publish:
    """Publish one small version; keyword arguments replace the defaults."""
    import numpy as np

    def _publish(name: str = "panda-cube", value: float = 0.0, **changes: Any) -> Version:
        fields: dict[str, Any] = {
            "spaces": {"action": {"shape": [4], "low": -1.0, "high": 1.0}},
            "normalisation": {"mean": [0.0, 0.5], "scale": [1.0, 2.0]},
            "config": {"seed": 3, "world": {"object": "cube"}},
            "metrics": {"bob/success_rate": 0.5},
        }
        return registry.publish(name, {"gate.weight": np.full((2, 3), value, np.float32)}, **(fields | changes))

    return _publish


@pytest.fixture(scope="session")
def champion() -> Trained:
    """The primitives in the box."""
    import service

    return service.load("panda-cube@champion", "no registry here")


@pytest.fixture
def full_disk(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], None]:
    """Call with "write" or "fsync": from then on that finds the disk full; a write first stores half its bytes."""

    def _write(path: Path, data: bytes | Iterator[bytes]) -> None:
        data = data if isinstance(data, bytes) else b"".join(data)
        path.write_bytes(data[: len(data) // 2])
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    def _fsync(descriptor: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    def _fill(call: str) -> None:
        if call == "write":
            monkeypatch.setattr("service.base.files._write_flushed", _write)
        else:
            monkeypatch.setattr(os, "fsync", _fsync)

    return _fill
