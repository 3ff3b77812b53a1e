"""The registry's index in a real Redis: kept up to date by the way, made again from the files, and never in the way."""

import json
import logging
import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from typer.testing import CliRunner

from service.cli.registry import registry_app
from service.registry import announcing
from service.registry.registry import BUNDLED, Registry
from service.store import keys
from service.store.errors import DamagedStoreError, StoreUnavailableError
from service.store.registry_index import RegistryIndex
from tests.cli.test_registry import assert_user_error
from tests.store.stores import Killable

ROOT = Path(__file__).parents[2]


@pytest.fixture
def redis(tmp_path):
    killable = Killable(tmp_path / "redis")
    yield killable
    killable.server.close()


@pytest.fixture
def index(redis, monkeypatch):
    """The index of the Redis that is configured."""
    monkeypatch.setenv("TANDEM_REDIS_URL", redis.address.url)
    return RegistryIndex(redis.address)


def run(*arguments):
    return CliRunner().invoke(registry_app, [str(argument) for argument in arguments])


def test_publishing_and_aliases_reach_the_index(registry, publish, index):
    publish()
    publish(value=1.0, parent="panda-cube@1", aliases=("latest", "champion"))
    registry.set_alias("panda-cube", "champion", 1)
    first, second = index.versions(registry.root)
    assert (first.name, first.version, second.version, second.parent) == ("panda-cube", 1, 2, "panda-cube@1")
    manifest = registry.manifest("panda-cube@1")
    assert (first.blob_sha256, first.blob_bytes, first.created) == (
        manifest.blob_sha256,
        manifest.blob_bytes,
        manifest.created,
    )
    digest = subprocess.run(
        ["sha256sum", registry.root / "models" / "panda-cube" / "versions" / "1"], capture_output=True, check=True
    )
    assert digest.stdout.split()[0].decode() == first.manifest_sha256
    assert index.aliases(registry.root, "panda-cube") == registry.aliases("panda-cube") == {"champion": 1, "latest": 2}
    assert index.aliases(registry.root, "nobody") == {}


def test_notices_tell_what_happened_in_order(registry, publish, index):
    assert index.notices(registry.root) == []
    publish()
    publish(value=1.0)
    registry.set_alias("panda-cube", "champion", 1)
    notices = index.notices(registry.root)
    assert [(each.event, each.reference, each.alias) for each in notices] == [
        ("published", "panda-cube@1", None),
        ("published", "panda-cube@2", None),
        ("alias", "panda-cube@1", "champion"),
    ]
    assert index.notices(registry.root, after=notices[1].id) == notices[2:]
    assert index.notices(registry.root, after=notices[2].id) == []


def test_waiting_for_the_next_notice(registry, publish, index):
    publisher = threading.Timer(0.2, publish)
    publisher.start()
    (notice,) = index.notices(registry.root, wait_s=30.0)
    assert notice.reference == "panda-cube@1"
    publisher.join()


def test_a_listener_of_ones_own(registry, redis):
    """A driver that has started a Redis of its own says so; nothing is configured."""
    own, index = Registry(registry.root, listener=RegistryIndex(redis.address)), RegistryIndex(redis.address)
    own.publish("panda-cube", {}, spaces={}, normalisation={}, config={}, metrics={})
    assert [each.version for each in index.versions(registry.root)] == [1]


def test_registries_in_one_redis_do_not_mix(registry, publish, index, tmp_path):
    publish()
    other = Registry(tmp_path / "other")
    other.publish("panda-cube", {}, spaces={}, normalisation={}, config={}, metrics={})
    other.publish("panda-cube", {}, spaces={}, normalisation={}, config={}, metrics={})
    assert [each.version for each in index.versions(registry.root)] == [1]
    assert [each.version for each in index.versions(other.root)] == [1, 2]
    assert run("reindex", "--registry", registry.root).exit_code == 0
    assert len(index.versions(other.root)) == 2


def test_many_publishers_and_alias_movers_at_once(registry, publish, index):
    publish()

    def work(number):
        publish(value=float(number))
        for version in (1, 2, 1):
            registry.set_alias("panda-cube", f"of-{number % 2}", version)

    threads = [threading.Thread(target=work, args=(number,)) for number in range(5)]
    publish(value=9.0)
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60.0)
    assert [each.version for each in index.versions(registry.root)] == list(range(1, 8))
    assert index.aliases(registry.root, "panda-cube") == registry.aliases("panda-cube")
    assert len(index.notices(registry.root)) == 7 + 15


# --- Redis is away ---------------------------------------------------------------------------------------------------


def test_nothing_fails_and_nothing_is_lost_while_redis_is_away(registry, publish, index, redis, caplog):
    publish()
    redis.kill()
    publish(value=1.0)
    registry.set_alias("panda-cube", "champion", 2)
    published, moved = caplog.messages
    assert "panda-cube@2 is in the registry, but not in its index" in published
    assert "panda-cube@champion is in the registry" in moved
    assert f"tandem registry reindex --registry {registry.root}" in published
    assert registry.aliases("panda-cube") == {"champion": 2, "latest": 2}
    with pytest.raises(StoreUnavailableError):
        index.versions(registry.root)
    redis.revive()
    assert len(index.versions(registry.root)) == 1
    result = run("reindex", "--registry", registry.root)
    assert result.stdout == f"{registry.root}: 2 versions in the index at {redis.address}\n"
    assert [each.version for each in index.versions(registry.root)] == [1, 2]
    assert index.aliases(registry.root, "panda-cube") == {"champion": 2, "latest": 2}


def test_publishing_does_not_wait_for_a_redis_that_hangs(publish, redis, index, caplog):
    os.kill(redis.server.pid, signal.SIGSTOP)
    try:
        publisher = threading.Thread(target=publish, daemon=True)
        publisher.start()
        publisher.join(20.0)
        assert not publisher.is_alive()
    finally:
        os.kill(redis.server.pid, signal.SIGCONT)
    assert "no answer in time" in caplog.text


def test_a_redis_that_lost_everything_is_indexed_again(registry, publish, index, redis):
    publish()
    before = index.versions(registry.root)
    redis.address.client(1.0).flushall()
    assert index.versions(registry.root) == []
    assert run("reindex", "--registry", registry.root).exit_code == 0
    assert index.versions(registry.root) == before


def test_what_is_no_longer_there_leaves_the_index(registry, publish, index):
    publish()
    publish(value=1.0)
    (registry.root / "models" / "panda-cube" / "versions" / "1").unlink()
    assert run("reindex", "--registry", registry.root).exit_code == 0
    assert [each.version for each in index.versions(registry.root)] == [2]


def test_a_damaged_manifest_or_alias_is_left_out_of_the_index(registry, publish, index, caplog):
    publish()
    publish(value=1.0)
    (registry.root / "models" / "panda-cube" / "versions" / "1").write_text("{}")
    (registry.root / "models" / "panda-cube" / "aliases" / "latest").write_text("x")
    assert index.rebuild(registry) == 1
    assert [each.version for each in index.versions(registry.root)] == [2]
    assert index.aliases(registry.root, "panda-cube") == {}
    assert ["left out of the index" in message for message in caplog.messages] == [True, True]


def test_somebody_publishes_while_the_index_is_made(registry, publish, index, monkeypatch):
    """The files were listed before, and the index is written after: the new version must not fall out of it."""
    publish()
    names, calls = Registry.names, []

    def names_and_then_somebody(self):
        found = names(self)
        if not calls:
            calls.append(publish(value=1.0))
            calls.append(publish("other"))
        return found

    monkeypatch.setattr(Registry, "names", names_and_then_somebody)
    assert index.rebuild(registry) == 3
    assert [(each.name, each.version) for each in index.versions(registry.root)] == [
        ("other", 1),
        ("panda-cube", 1),
        ("panda-cube", 2),
    ]


@pytest.mark.parametrize("damage", ["content", "type"])
def test_a_damaged_index(registry, publish, index, redis, damage, caplog):
    publish()
    client, key = redis.address.client(1.0), keys.registry(registry.root, "versions")
    if damage == "content":
        client.hset(key, "panda-cube@1", b"{}")
    else:
        client.delete(key)
        client.set(key, 1)
        publish(value=1.0)
        assert "WRONGTYPE" in caplog.text
    with pytest.raises(DamagedStoreError, match="tandem registry reindex"):
        index.versions(registry.root)
    assert run("reindex", "--registry", registry.root).exit_code == 0
    assert index.versions(registry.root) != []


# --- the command -----------------------------------------------------------------------------------------------------


def test_reindex_without_a_redis(registry, publish, redis, monkeypatch, tmp_path):
    publish()
    monkeypatch.delenv("TANDEM_REDIS_URL", raising=False)
    assert_user_error(run("reindex", "--registry", registry.root), "no Redis", "TANDEM_REDIS_URL")
    monkeypatch.setenv("TANDEM_REDIS_URL", "redis://:hidden/pw@host")
    result = run("reindex", "--registry", registry.root)
    assert_user_error(result, "TANDEM_REDIS_URL is no Redis URL")
    assert "hidden" not in result.stderr
    assert_user_error(run("reindex", "--registry", tmp_path / "none"), "no registry at", "none")
    redis.kill()
    monkeypatch.setenv("TANDEM_REDIS_URL", redis.address.url)
    result = run("reindex", "--registry", registry.root)
    assert result.exit_code == 1
    assert result.stderr.startswith(f"error: Redis at {redis.address}: ")
    assert result.stderr.count("\n") == 1


def test_the_bundled_registry_can_be_indexed(index):
    assert run("reindex", "--registry", BUNDLED).exit_code == 0
    assert {each.name for each in index.versions(BUNDLED)} == set(Registry(BUNDLED).names())


# --- without Redis ---------------------------------------------------------------------------------------------------


def test_a_url_that_is_of_no_use_is_warned_of_once(publish, monkeypatch, caplog):
    monkeypatch.setenv("TANDEM_REDIS_URL", "redis://:se/cret@nowhere")
    announcing._listener.cache_clear()
    with caplog.at_level(logging.WARNING):
        publish()
        publish(value=1.0)
    (message,) = caplog.messages
    assert "index is not kept up to date" in message
    assert "cret" not in message


@pytest.mark.parametrize("configured", [False, True])
def test_the_registry_works_without_the_package_redis(tmp_path, configured):
    code = """
import sys
sys.modules["redis"] = None
from pathlib import Path
import service, service.cli.registry
from service.registry.registry import Registry
fields = dict(spaces={}, normalisation={}, config={}, metrics={})
print(Registry(Path(sys.argv[1])).publish("panda-cube", {}, **fields))
"""
    environment = {key: value for key, value in os.environ.items() if key != "TANDEM_REDIS_URL"}
    environment |= {"TANDEM_REDIS_URL": "redis://localhost"} if configured else {}
    result = subprocess.run(
        [sys.executable, "-c", code, tmp_path], capture_output=True, text=True, check=True, env=environment, cwd=ROOT
    )
    assert result.stdout == "panda-cube@1\n"
    assert ("pip install" in result.stderr) is configured


def test_reading_a_registry_does_not_import_redis(registry, publish):
    publish()
    code = """
import json, sys
from pathlib import Path
from service.registry.registry import Registry
Registry(Path(sys.argv[1])).load("panda-cube")
print(json.dumps([name for name in sys.modules if name.partition(".")[0] == "redis"]))
"""
    environment = os.environ | {"TANDEM_REDIS_URL": "redis://localhost"}
    result = subprocess.run(
        [sys.executable, "-c", code, registry.root],
        capture_output=True,
        text=True,
        check=True,
        env=environment,
        cwd=ROOT,
    )
    assert json.loads(result.stdout) == []
