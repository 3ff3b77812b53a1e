"""Starting a Ray of our own on a machine that is slow; the real one is in test_cluster and test_job."""

import os
import subprocess
import sys

import pytest
import ray

from service.runtime.ray_connection import START_ATTEMPTS, connected
from service.runtime.runner import ClusterError
from tests.runtime.runs import ROOT, assert_one_line

SLOW = "The current node timed out during startup. This could happen because some of the raylet failed to startup"


@pytest.fixture
def starts(monkeypatch):
    """Every start that was tried, and how many of them fail for lack of time."""
    tried, failing = [], [0]

    def init(*arguments, **options):
        tried.append(arguments)
        if len(tried) <= failing[0]:
            raise Exception(SLOW)

    monkeypatch.setattr(ray, "init", init)
    monkeypatch.setattr(ray, "shutdown", lambda: None)
    monkeypatch.setattr("service.runtime.ray_connection._check_token", lambda address: None)
    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    return tried, failing


def test_a_start_that_took_too_long_is_tried_again(starts):
    tried, failing = starts
    failing[0] = START_ATTEMPTS - 1
    with connected(None):
        assert tried == [("local",)] * START_ATTEMPTS


def test_a_ray_that_never_starts_is_one_line(starts):
    tried, failing = starts
    failing[0] = START_ATTEMPTS
    with pytest.raises(ClusterError) as error, connected(None):
        pass
    assert len(tried) == START_ATTEMPTS
    assert_one_line(error.value, "Ray does not start here", "timed out during startup")


def test_another_cluster_is_asked_once(starts):
    tried, failing = starts
    failing[0] = 1
    with pytest.raises(ClusterError), connected("auto"):
        pass
    assert tried == [("auto",)]


LISTENING = """
import psutil
from service.runtime.ray_connection import connected
with connected(None, num_cpus=1):
    import ray

    @ray.remote
    class Worker:
        def ping(self):
            pass

    worker = Worker.remote()
    ray.get(worker.ping.remote())
    me = psutil.Process()
    for process in (me, *me.children(recursive=True)):
        for each in process.net_connections(kind="tcp"):
            if each.status == psutil.CONN_LISTEN:
                print(each.laddr.ip)
"""


def test_a_ray_of_our_own_listens_on_loopback_only():
    environment = {name: value for name, value in os.environ.items() if not name.startswith("RAY_")}
    command = [sys.executable, "-c", LISTENING]
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    addresses = done.stdout.split()
    assert len(addresses) >= 8  # of its control store, node, agents, worker and this driver
    assert set(addresses) <= {"127.0.0.1", "::1", "::ffff:127.0.0.1"}
