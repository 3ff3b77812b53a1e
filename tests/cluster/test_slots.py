"""Actors without Ray: the lag of rollouts, bounded by counting them, and which failures end the run."""

from types import SimpleNamespace

import pytest
import ray
from ray.exceptions import ActorDiedError, RayTaskError

from service.actors.rollout import MAX_POLICY_LAG
from service.base.user_code import CodeError
from service.cluster import actor_pool, ray_actors, remote_worker
from service.cluster.actor_pool import RESTART_S, ActorPool
from service.cluster.iteration import may_begin, may_update
from service.cluster.ray_actors import GeneratorActor
from service.cluster.ray_connection import ClusterOptions
from service.cluster.remote_worker import RemoteWorker
from service.cluster.self_play import MAX_FAILED_ROUNDS, RaySelfPlay
from service.cluster.watch import Clock
from service.generator.generator import TaskGenerator
from service.methods.method import WorkersError
from tests.runs.runs import tiny_config


def test_an_update_waits_for_a_round_that_would_get_too_old():
    assert may_update(3, [3])  # 4 comes out; the slow round can be learned from by 4 to make 5: 1 behind
    assert may_update(4, [3, 4])  # 5 comes out: 2 behind
    assert not may_update(5, [3, 5])
    assert may_update(5, [])


@pytest.mark.parametrize("num_actors", [1, 2, 5])
@pytest.mark.parametrize("slowness", [1, 7])
def test_no_order_of_events_lets_a_rollout_get_too_old(num_actors, slowness):
    """Actor 0 is ``slowness`` times slower than the others, an update takes as long as a round."""
    version, learning, learned_at, lags = 0, [], 0, []
    playing, done = {}, []  # versions, and when the round is over
    for now in range(400):
        for actor, (began, until) in list(playing.items()):
            if now >= until:
                done.append(began)
                del playing[actor]
        if learning and now >= learned_at:
            lags += [version - began for began in learning]
            version, learning = version + 1, []
        if not learning and len(done) >= num_actors and may_update(version, [began for began, _ in playing.values()]):
            learning, done, learned_at = done, [], now + 10
        for actor in range(num_actors):
            if actor not in playing and may_begin(len(playing) + len(done) + len(learning), num_actors):
                playing[actor] = version, now + 10 * (slowness if actor == 0 else 1)
    assert version >= (5 if slowness > 1 else 30)
    assert max(lags) <= MAX_POLICY_LAG
    if slowness == 1:
        assert sum(lags) / len(lags) <= 1
    if num_actors == 1:
        assert set(lags) == {0, 1}  # one round is played while another is learned from, never two


@pytest.fixture
def method(monkeypatch):
    """A driver without Ray and with no actors yet, of which none ever starts: each dies when it is asked for that."""

    def dies(reference):
        raise ActorDiedError

    handle = SimpleNamespace(ping=SimpleNamespace(remote=object))
    monkeypatch.setattr(actor_pool, "remote_actor", lambda *_, **__: SimpleNamespace(remote=lambda *_: handle))
    monkeypatch.setattr(ray, "kill", lambda handle: None)
    monkeypatch.setattr(ray, "get", dies)
    method = RaySelfPlay(tiny_config(), ClusterOptions())
    method._pool = ActorPool(method.config, 1, 0, method._clock)
    return method


def test_all_actors_of_a_node_may_fail_at_once_and_not_for_ever(method):
    method._pool.resize(MAX_FAILED_ROUNDS + 10)

    def lose_all():
        for slot in list(method._pool):
            method._take_from_actor(slot, {slot.starting})

    lose_all()
    with pytest.raises(WorkersError, match=f"^{2 * MAX_FAILED_ROUNDS + 11} rollout actors in a row failed"):
        lose_all()


def test_a_start_that_waits_for_a_core_is_no_failure_and_one_that_dies_is(method):
    worker = SimpleNamespace(end_if_hung=lambda: None)
    method._learner = method._generator = worker
    method._last_resize = float("inf")
    method._pool.resize(1)
    (first,) = method._pool
    method._clock.now = RESTART_S + 1.0
    method._check_workers()
    (again,) = method._pool
    assert again is not first
    assert (again.watch.incarnation, again.last_error, method._last_error) == (0, None, None)
    assert again.status().num_replaced == 0
    method._take_from_actor(again, {again.starting})
    (replaced,) = method._pool
    assert replaced.watch.incarnation == replaced.status().num_replaced == 1
    assert "died" in replaced.last_error
    method._clock.now *= 10.0
    method._check_workers()
    (last,) = method._pool
    assert (last.watch.incarnation, last.last_error) == (1, replaced.last_error)


def test_actors_that_join_a_resumed_run_do_not_count_as_replaced(method):
    pool = ActorPool(method.config, 1, 5, method._clock)
    pool.resize(2)
    assert [(slot.status().incarnation, slot.status().num_replaced) for slot in pool] == [(5, 0), (5, 0)]


def test_the_number_of_actors_follows_the_cores_of_the_cluster(method, monkeypatch):
    def size_with(cores, *alive, **options):
        monkeypatch.setattr(ray, "cluster_resources", lambda: {"CPU": cores})
        method._options = ClusterOptions(**options)
        method._last_resize = -float("inf")
        for slot in method._pool:
            slot.watch.location = {"node": "here", "pid": 1} if slot.index in alive else None
        method._check_workers()
        return [slot.index for slot in method._pool]

    method._learner = method._generator = SimpleNamespace(end_if_hung=lambda: None)
    assert size_with(4.0) == [0, 1, 2, 3]
    assert size_with(4.0, learner_cpus=1.0) == [0, 1, 2]
    assert size_with(9.0, actor_threads=4) == [0, 1]
    assert size_with(4.0) == [0, 1, 2, 3]
    assert size_with(2.0, 1, 2, 3) == [1, 2, 3]  # those that play go on: their node may be lost, or not
    assert size_with(0.0) == [1]
    assert size_with(4.0, num_actors=2) == [1, 0]


def test_a_worker_is_started_four_times_with_longer_and_longer_pauses(monkeypatch):
    waits, spawned = [], []

    def dies(worker):
        raise ActorDiedError

    monkeypatch.setattr(ray, "put", lambda value: value)
    monkeypatch.setattr(RemoteWorker, "_spawn", lambda worker, number: spawned.append(number))
    monkeypatch.setattr(RemoteWorker, "_wait_until_ready", dies)
    monkeypatch.setattr(RemoteWorker, "close", lambda worker: None)
    monkeypatch.setattr(remote_worker.time, "sleep", waits.append)
    worker = RemoteWorker("learner", None, None, None, Clock(), lambda: None)
    worker.watch = SimpleNamespace(incarnation=0)
    with pytest.raises(WorkersError, match=r"^the learner died 4 times while it started, at last with: ActorDied"):
        worker.start()
    assert waits == [0.5, 1.0, 2.0]
    assert len(spawned) == 4


def test_an_actor_counts_its_rounds_for_prometheus(monkeypatch):
    counted = []

    def recorder(name, description, tag_keys, boundaries=None):
        def count(value, tags):
            assert tuple(tags) == tag_keys
            counted.append((name, value, tags["actor"]))

        return SimpleNamespace(inc=count, observe=count)

    monkeypatch.setattr(ray_actors, "Counter", recorder)
    monkeypatch.setattr(ray_actors, "Histogram", recorder)
    ray_actors._round_counters(3)(SimpleNamespace(num_env_steps=640, play_s=1.5))
    assert counted == [
        ("tandem_actor_env_steps", 640, "3"),
        ("tandem_actor_rounds", 1, "3"),
        ("tandem_actor_round_seconds", 1.5, "3"),
    ]


def test_an_error_in_code_of_a_users_ends_the_run(method, monkeypatch):
    def fails(reference):
        raise RayTaskError("play_round", "its traceback", CodeError("mine.py:3: NameError"))

    method._pool.resize(1)
    (slot,) = method._pool
    slot.round = SimpleNamespace(answer="answer", started=0.0)
    monkeypatch.setattr(ray, "get", fails)
    with pytest.raises(CodeError, match=r"^mine\.py:3: NameError$"):
        method._take_from_actor(slot, {"answer"})


def test_a_run_that_had_converged_has_converged_when_it_goes_on(method, monkeypatch):
    monkeypatch.setattr(ray_actors, "_fetch", list)
    monkeypatch.setattr(TaskGenerator, "should_stop", lambda generator: True)
    *_, should_stop, _ = GeneratorActor(method.config).start([None])
    method._learner = SimpleNamespace(made=["weights", "learner"])
    method._generator = SimpleNamespace(made=["generator", "snapshot", should_stop, "opponents"])
    monkeypatch.setattr(ray, "get", lambda value: value)
    assert not method.converged
    method._hand_out(has_new_opponents=True)
    assert method.converged
