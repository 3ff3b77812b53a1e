"""Services on loopback, each with the same two runs and a registry of two versions."""

import shutil
from collections.abc import Iterator
from datetime import timedelta
from pathlib import Path

import httpx
import pytest

from service.registry.registry import Registry
from service.status.server import StatusServer
from service.store import models
from service.store.disk_reader import DiskReader
from tests.status.runs import BEARER, CLIENT, TOKEN, publish, write_runs


@pytest.fixture(autouse=True)
def slow_tests(monkeypatch: pytest.MonkeyPatch) -> None:
    """A run that was written when a module's tests began is heard of long enough for all of them."""
    monkeypatch.setattr(models, "SILENT_AFTER", timedelta(hours=1))


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The directory of ``runs`` and ``registry``."""
    home = tmp_path_factory.mktemp("status")
    write_home(home)
    return home


def write_home(home: Path) -> None:
    """Write two runs and a registry of two versions, in place of what is there."""
    shutil.rmtree(home)
    write_runs(home / "runs")
    registry = Registry(home / "registry")
    publish(registry, value=1.0)
    publish(registry, value=2.0)
    registry.set_alias("tiny", "champion", 1)


def serve(home: Path, *, token: str | None = TOKEN, host: str = "127.0.0.1", port: int = 0) -> StatusServer:
    """Make a service of the runs and the registry in ``home``; it is not started."""
    runs = home / "runs"
    return StatusServer(DiskReader(runs), Registry(home / "registry"), token=token, host=host, port=port)


@pytest.fixture(scope="module")
def server(home: Path) -> Iterator[StatusServer]:
    """A service with a token, on loopback."""
    with serve(home) as server:
        yield server


@pytest.fixture(scope="module")
def client(server: StatusServer) -> Iterator[httpx.Client]:
    """A client of that service, with its token."""
    with httpx.Client(base_url=server.url, headers=BEARER, **CLIENT) as client:
        yield client
