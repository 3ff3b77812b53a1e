"""Connections to Ray: a slow machine, a wrong token, errors of workers; real runs are in test_cluster and test_job."""

import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import grpc
import pytest
import ray
from ray.exceptions import ActorDiedError, RayTaskError

from service.base.errors import DivergedError
from service.cluster.ray_connection import START_ATTEMPTS, connected, explaining_ray_errors
from service.methods.method import WorkersError
from tests.runs.runs import ROOT, assert_one_line

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
    monkeypatch.setattr("service.cluster.ray_connection._check_token", lambda address: None)
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
    with pytest.raises(WorkersError) as error, connected(None):
        pass
    assert len(tried) == START_ATTEMPTS
    assert_one_line(error.value, "Ray does not start here", "timed out during startup")


def test_another_cluster_is_asked_once(starts):
    tried, failing = starts
    failing[0] = 1
    with pytest.raises(WorkersError), connected("auto"):
        pass
    assert tried == [("auto",)]


LISTENING = """
import psutil
from service.cluster.ray_connection import connected
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


# --- the token --------------------------------------------------------------------------------------------------------


class Head(grpc.GenericRpcHandler):
    """Answers like the head of a cluster that wants a token, or like something else that speaks gRPC."""

    def __init__(self, token, error=grpc.StatusCode.UNAUTHENTICATED):
        self._token, self._error = token, error

    def service(self, details):
        given = dict(details.invocation_metadata).get("authorization")

        def answer(request, context):
            assert details.method == "/ray.rpc.NodeInfoGcsService/GetClusterId"
            if given != f"Bearer {self._token}":
                context.abort(self._error, "InvalidAuthToken:\nmissing or incorrect")
            return b""

        return grpc.unary_unary_rpc_method_handler(answer)


@pytest.fixture
def serve(monkeypatch):
    """Start a head; gives its address. This machine's own address is not asked for."""
    monkeypatch.setattr("ray._private.services.canonicalize_bootstrap_address", lambda address: address)
    servers = []

    def start(head):
        servers.append(grpc.server(ThreadPoolExecutor(max_workers=1), handlers=[head]))
        port = servers[-1].add_insecure_port("127.0.0.1:0")
        servers[-1].start()
        return f"127.0.0.1:{port}"

    yield start
    for server in servers:
        server.stop(grace=None)


def test_a_wrong_token_is_named_before_ray_is_asked(serve, monkeypatch):
    monkeypatch.setattr(ray, "init", lambda *arguments, **options: pytest.fail("Ray tries for 20 s"))
    address = serve(Head("a" * 64))
    with pytest.raises(WorkersError) as error, connected(address):
        pass
    assert_one_line(
        error.value, address, "it refuses the token that was sent: set RAY_AUTH_TOKEN", "InvalidAuthToken: "
    )
    monkeypatch.setenv("RAY_AUTH_MODE", "disabled")
    with pytest.raises(WorkersError) as error, connected(address):
        pass
    assert_one_line(error.value, "it wants a token, and none was sent: set RAY_AUTH_MODE=token, and RAY_AUTH_TOKEN")


def test_the_right_token_goes_on_to_ray(serve, monkeypatch):
    tried = []
    monkeypatch.setattr(ray, "init", lambda *arguments, **options: tried.append(arguments))
    monkeypatch.setattr(ray, "shutdown", lambda: None)
    address = serve(Head(os.environ["RAY_AUTH_TOKEN"]))
    with connected(address):
        assert tried == [(address,)]


def test_somebody_else_at_that_port(serve, monkeypatch):
    monkeypatch.setattr(ray, "init", lambda *arguments, **options: pytest.fail("Ray tries for 20 s"))
    with pytest.raises(WorkersError) as error, connected(serve(Head("", grpc.StatusCode.UNAVAILABLE))):
        pass
    assert_one_line(error.value, "no Ray cluster answers there")


# --- workers ----------------------------------------------------------------------------------------------------------


def dies():
    raise ActorDiedError  # Ray gives it a sentence


def remote_error(cause):
    """As ``ray.get`` raises it: an error of both kinds, whose text is the worker's traceback."""
    text = f'ray::Learner.update() (pid=1)\n  File "x.py", line 1\n{type(cause).__name__}: {cause}'
    return RayTaskError("update", f"Traceback (most recent call last):\n{text}", cause).as_instanceof_cause()


def test_what_a_worker_raises_for_people_is_raised_here():
    with pytest.raises(DivergedError) as error, explaining_ray_errors():
        raise remote_error(DivergedError("lower the rates"))
    assert type(error.value) is DivergedError
    assert str(error.value) == "lower the rates"


def test_any_other_error_of_a_worker_is_its_last_line():
    with pytest.raises(RuntimeError) as error, explaining_ray_errors():
        raise remote_error(KeyError("x"))
    assert str(error.value) == "a worker failed: KeyError: 'x'"
    assert 'File "x.py", line 1' in str(error.value.__cause__)


def test_an_error_of_rays_own_is_one_line():
    with pytest.raises(WorkersError) as error, explaining_ray_errors():
        dies()
    assert_one_line(error.value, "Ray gave up: ActorDiedError: The actor died unexpectedly", "--resume")


@pytest.mark.parametrize(
    ("address", "said"), [("127.0.0.1:1", "no Ray cluster answers there"), ("head:x", "HOST:PORT")]
)
def test_no_cluster_at_an_address_is_one_line(address, said):
    with pytest.raises(WorkersError, match=said) as error, connected(address):
        pass
    assert "\n" not in str(error.value)
    assert address in str(error.value)
