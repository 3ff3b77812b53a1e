"""A Redis server of its own for a test."""

import pytest

from service.store import redis_writer
from tests.store.redis_server import RedisServer


@pytest.fixture
def redis(tmp_path):
    with RedisServer(tmp_path / "redis") as server:
        yield server


@pytest.fixture(autouse=True)
def impatient(monkeypatch):
    """Ten times as fast as for people."""
    monkeypatch.setattr(redis_writer, "TICK_S", 0.05)
    monkeypatch.setattr(redis_writer, "RETRY_S", 0.1)


@pytest.fixture(autouse=True)
def no_redis_configured(monkeypatch):
    monkeypatch.delenv("TANDEM_REDIS_URL", raising=False)
