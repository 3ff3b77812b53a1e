"""Where Redis is: passwords stay out of every text, and what is wrong is said in one line."""

import pickle
import socket
import traceback

import pytest

from service.base.errors import StoreError, StoreUnavailableError, TandemError
from service.store.address import RedisAddress, address_from_environment
from service.store.redis_reader import RedisReader
from tests.runs.runs import assert_one_line

SECRET = "s3cret-word"


def test_as_text_it_has_no_password():
    address = RedisAddress(f"redis://worker:{SECRET}@redis.lab:6390/2?socket_timeout=3&password={SECRET}")
    assert str(address) == "redis://redis.lab:6390/2"
    assert SECRET not in f"{address} {address!r} {[address]} {address.client(1.0)!r}"
    assert address.client(1.0).get_retry().get_retries() == 0
    assert pickle.loads(pickle.dumps(address)) == address


def test_forms_of_a_url(monkeypatch):
    for url, shown in (
        ("redis://localhost", "redis://localhost:6379"),
        ("rediss://:pw@[::1]:7000/1", "rediss://[::1]:7000/1"),
        ("unix:///run/redis.sock?password=pw", "unix:///run/redis.sock"),
    ):
        assert str(RedisAddress(url)) == shown
    assert address_from_environment() is None
    monkeypatch.setenv("TANDEM_REDIS_URL", " ")
    assert address_from_environment() is None


@pytest.mark.parametrize(
    "url",
    [f"redis://:{SECRET}/x@host", f"http://{SECRET}@host", f"{SECRET}", f"redis://:{SECRET}@", "redis://host:port"],
)
def test_a_bad_url_is_not_quoted(monkeypatch, url):
    monkeypatch.setenv("TANDEM_REDIS_URL", url)
    with pytest.raises(StoreError) as error:
        address_from_environment()
    assert_one_line(error.value, "TANDEM_REDIS_URL", "redis://[[USER]:PASSWORD@]HOST")
    shown = "".join(traceback.format_exception(error.value)[-1:]) + str(error.value)
    assert SECRET not in shown
    assert "port" not in str(error.value).lower().replace("[:port]", "")


def test_no_server_there():
    with socket.socket() as taken:  # bound, and nobody listens
        taken.bind(("127.0.0.1", 0))
        address = RedisAddress(f"redis://:{SECRET}@127.0.0.1:{taken.getsockname()[1]}/0")
        with pytest.raises(StoreUnavailableError) as error:
            RedisReader(address).ready()
    assert_one_line(error.value, f"Redis at {address}", "refused", "check TANDEM_REDIS_URL")
    assert SECRET not in str(error.value)
    assert error.value.exit_code == 1


def test_a_wrong_password_and_none(redis):
    host = redis.address.url.rpartition("@")[2]
    for url in (f"redis://:{SECRET}@{host}", f"redis://{host}", f"redis://nobody:{SECRET}@{host}"):
        with pytest.raises(StoreUnavailableError) as error:
            RedisReader(RedisAddress(url)).ready()
        assert_one_line(error.value, "wrong or missing password", "TANDEM_REDIS_URL")
        assert SECRET not in str(error.value)
    RedisReader(redis.address).ready()


def test_the_package_is_missing(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "redis.connection", None)
    with pytest.raises(TandemError) as error:
        RedisAddress("redis://localhost")
    assert_one_line(error.value, "TANDEM_REDIS_URL is set", "pip install 'tandem-skills[cluster]'")
