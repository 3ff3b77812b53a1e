"""Connections to Ray: a slow machine, errors of workers; real runs are in test_cluster and test_job."""

import pytest
import ray
from ray.exceptions import ActorDiedError, RayTaskError

from service.base.errors import DivergedError, TandemError
from service.cluster.ray_connection import START_ATTEMPTS, _explained, connected, explaining_ray_errors
from service.methods.method import WorkersError
from tests.runs.runs import assert_one_line

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


@pytest.mark.parametrize(
    ("said", "told"),
    [
        ("Version mismatch: The cluster was started with: Ray: 2.59.0", "it runs other versions of Ray or Python"),
        ("Authentication failed", "set RAY_AUTH_TOKEN"),
        ("Invalid token", "set RAY_AUTH_TOKEN"),
        ("nobody is at home", "no Ray cluster answers there"),
    ],
)
def test_why_a_cluster_cannot_be_used_is_said_in_a_line(said, told):
    assert_one_line(_explained("head:6379", RuntimeError(f"{said}\n  and more")), "--address head:6379", told, said)


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
    with pytest.raises(TandemError, match=said) as error, connected(address):
        pass
    assert error.value.exit_code == (2 if said == "HOST:PORT" else 1)  # what was typed, or what is there
    assert "\n" not in str(error.value)
    assert address in str(error.value)
