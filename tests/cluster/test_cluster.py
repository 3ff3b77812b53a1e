"""Self-play on a real Ray: the same experiment as in one process, and workers that are killed or hang are replaced."""

import os
import re
import signal
import time
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import ray
from ray.exceptions import ObjectLostError
from torch import cuda

from benchmarks.processes import descendants
from service.base.errors import ConfigError
from service.cluster import actor_pool, self_play, watch
from service.cluster.ray_actors import NICENESS
from service.cluster.ray_connection import ClusterOptions, connected, explaining_ray_errors, num_gpus
from service.cluster.ray_runtime import RayRuntime
from service.cluster.remote_worker import RemoteWorker
from service.cluster.self_play import RaySelfPlay
from service.cluster.watch import RayletWatch
from service.cluster.worker_variables import WORKER_VARIABLES
from service.config import changed_config
from service.methods.method import StateLostError, WorkersError
from service.policies.parameters import PolicyError
from service.runs.run import Run
from service.runs.train import open_run
from service.store.checkpoints import CheckpointStore
from service.store.run_directory import RunDirectory
from tests.runs.runs import FullForAWhile, assert_one_line, is_alive, newest, play, read_lines, run_on, tiny_config

ENDLESS = 10**9
GOALS = """
from tandem_skills import GoalSource

class Mine(GoalSource):
    def goals(self, known, rng):
        return known.random(rng)[:, None]
"""


@pytest.fixture(scope="module", autouse=True)
def cluster():
    """A Ray of our own with four logical cores, for all tests of this file. Its workers inherit three variables."""
    with ExitStack() as stack:
        with pytest.MonkeyPatch.context() as patch:
            patch.setenv("OPENBLAS_NUM_THREADS", "7")
            patch.setenv("MUJOCO_GL", "glfw")
            patch.setenv("RAY_OVERRIDE_RESOURCES", '{"CPU": 4}')
            stack.enter_context(connected(None))
        yield


def run_cluster(
    path, config=None, story=None, *, num_actors=2, threads=1, resume=False, on_iteration=None, on_beat=None
):
    """Run until the budget is spent or the story is over; returns the run, closed, and how it ended.

    A story is a generator of a run, which goes on at every iteration.
    """
    directory = RunDirectory(path)
    runtime = RayRuntime(ClusterOptions(num_actors=num_actors, actor_threads=threads))
    config = config or tiny_config(total_env_steps=ENDLESS)
    run = open_run(config, directory, resume=resume, runtime=runtime)
    told = story(run) if story is not None else None

    def each(metrics):
        if on_iteration is not None:
            on_iteration(run, metrics)
        if told is not None and next(told, "over") == "over":
            run.request_stop()

    try:
        return run, run_on(run, each, lambda: on_beat(run) if on_beat else None)
    finally:
        run.close()
        directory.close()


def workers_of(run):
    return {actor.name: actor for actor in run.method.health().actors}


def send(run, name, number):
    """Send a signal to a worker; returns its process id."""
    pid = workers_of(run)[name].pid
    os.kill(pid, number)
    return pid


def all_there(run, num, gone=()):
    """Wait for so many iterations in a row with all workers there, none of them one of these processes."""
    since = 0
    while since < num:
        yield
        pids = {actor.pid for actor in workers_of(run).values()}
        since = 0 if pids & {None, *gone} else since + 1


def ids(path):
    """(actor, incarnation, highest sequence) of the rollouts that the newest checkpoint counts."""
    return newest(path).arrays["learner/counted"].tolist()


def num_counted(path):
    """Rollouts that actors have handed over, if none of them is missing."""
    return sum(highest + 1 for _, _, highest in ids(path))


def assert_all_updates_are_there(path):
    rows = read_lines(path / "metrics.jsonl")
    assert [row["iteration"] for row in rows] == list(range(1, len(rows) + 1))
    versions = [row["learner/version"] for row in rows if "learner/version" in row]
    assert versions == list(range(1, len(versions) + 1))
    assert (np.diff([row["env_steps"] for row in rows]) > 0).all()


def test_one_actor_plays_and_learns_what_one_process_does_and_stops_at_once(tmp_path):
    torch, nice, asked = {}, {}, []

    def look(run):
        yield from all_there(run, 7)  # with replayed goals and past opponents; all have unpickled weights
        for name, actor in workers_of(run).items():
            torch[name] = "libtorch" in Path(f"/proc/{actor.pid}/maps").read_text()
            nice[name] = os.getpriority(os.PRIO_PROCESS, actor.pid)
        asked.append(run.iteration)

    mine = tmp_path / "mine.py"
    mine.write_text(GOALS)
    plain = tiny_config(total_env_steps=ENDLESS, checkpoint_interval=10**6)
    config = changed_config(plain, [f"generator.goal_source={mine}"]).begin(tmp_path, None)
    mine.unlink()  # its text goes to the workers
    run, result = run_cluster(tmp_path / "ray", config, look, num_actors=1)
    assert (result.reason, [result.iteration]) == ("interrupted", asked)  # no other round was waited for
    assert CheckpointStore(tmp_path / "ray" / "checkpoints", keep=1).steps()[-1] == result.iteration
    assert run.method.grid().iteration == result.iteration
    # Only the learner has torch: an actor with it takes three times the memory and comes up three times as slowly.
    assert torch == {"rollout-0": False, "learner": True, "generator": False}
    # Workers that compute give way to those that answer.
    answers = nice.pop("generator")
    assert set(nice.values()) == {min(19, answers + NICENESS)}
    assert answers < 19

    play(
        tmp_path / "local",
        config,
        on_iteration=lambda run, metrics: run.iteration > result.iteration and run.request_stop(),
    )
    local, cluster = (read_lines(tmp_path / name / "metrics.jsonl") for name in ("local", "ray"))
    goals = [read_lines(tmp_path / name / "goals.jsonl") for name in ("local", "ray")]
    assert goals[1] == goals[0][: len(goals[1])]
    # One process records the update on the rollout of iteration i with iteration i + 1, here it is the same record.
    assert len(local) == len(cluster) + 1
    for index, found in enumerate(cluster):
        played = {name: value for name, value in local[index].items() if name.startswith(("alice/", "bob/"))}
        assert {name: found[name] for name in played} == played
        assert found["env_steps"] == local[index]["env_steps"]
        learned = {name: value for name, value in local[index + 1].items() if name.startswith("learner/")}
        assert {name: found[name] for name in learned} == learned
        others = {name for name in local[index] if not name.startswith("learner/")}
        assert set(found) == others | set(learned) | {"time/learn_s"}


def test_actors_share_the_worlds_and_a_checkpoint_belongs_to_no_topology(tmp_path):
    seen, told = [], FullForAWhile("ray")

    def look(run, metrics):
        seen.append(metrics)
        told(run, metrics)

    run, first = run_cluster(tmp_path, tiny_config(total_env_steps=1500), num_actors=3, on_iteration=look)
    told.check()
    assert run.method._pool.config.game.num_worlds == 8
    health = run.method.health()
    assert health.num_rollouts_refused == 0
    assert num_counted(tmp_path) == health.num_rollouts_counted
    assert max(row["learner/max_policy_lag"] for row in seen) <= 2
    assert np.mean([row["learner/policy_lag"] for row in seen]) <= 1
    assert newest(tmp_path).meta["env_steps"] == first.num_env_steps == seen[-1]["env_steps"]

    _, second = play(tmp_path, tiny_config(total_env_steps=1900), resume=True)  # with a pending rollout
    run, third = run_cluster(tmp_path, tiny_config(total_env_steps=2300), num_actors=1, resume=True)
    assert all(result.reason == "finished" for result in (first, second, third))
    assert first.num_env_steps < second.num_env_steps < third.num_env_steps
    assert_all_updates_are_there(tmp_path)
    rows = read_lines(tmp_path / "metrics.jsonl")
    assert all(row.get("learner/non_finite_steps", 0.0) == 0.0 for row in rows)
    assert {incarnation for _, incarnation, _ in ids(tmp_path)} == {0, 1, 2}  # one for each process
    assert run.method.health().num_rollouts_counted == third.iteration - second.iteration + 1


def test_workers_that_are_killed_are_replaced_and_no_others(tmp_path, monkeypatch):
    """One by one, several at once, before the run has begun, and while the successor starts.

    Each save takes a minute, by the clock that workers are judged by, and so does the start of each successor.
    """
    killed, doomed, lost_s = [], ["learner"], [0.0]
    monkeypatch.setattr(watch, "time", SimpleNamespace(monotonic=lambda: time.monotonic() + lost_s[0]))
    save, wait = Run._save, RemoteWorker._wait_until_ready

    def save_slowly(run):
        lost_s[0] += 60.0
        save(run)

    def kill_some(worker):
        """Once its process is up, and before it has its state."""
        lost_s[0] += 60.0
        if worker.name in doomed:
            doomed.remove(worker.name)
            os.kill(ray.get(worker.watch.handle.ping.remote())["pid"], signal.SIGKILL)
        wait(worker)

    monkeypatch.setattr(Run, "_save", save_slowly)
    monkeypatch.setattr(RemoteWorker, "_wait_until_ready", kill_some)
    incarnations = {}

    def strike(run):
        for names in (["generator", "rollout-1"], ["learner", "rollout-1"]):
            yield from all_there(run, 5, killed)  # each has some rollouts or updates
            assert not doomed
            doomed.extend({"learner"}.intersection(names))
            killed.extend(send(run, name, signal.SIGKILL) for name in names)
        yield from all_there(run, 5, killed)
        incarnations.update({name: actor.num_replaced for name, actor in workers_of(run).items()})

    run, result = run_cluster(tmp_path, story=strike)
    assert result.reason == "interrupted"
    assert lost_s[0] >= 60.0 * 8
    assert_all_updates_are_there(tmp_path)
    assert incarnations == {"rollout-0": 0, "rollout-1": 2, "learner": 3, "generator": 1}  # each as often as killed
    assert {tuple(each[:2]) for each in ids(tmp_path)} == {(0, 0), (1, 0), (1, 1), (1, 2)}
    assert num_counted(tmp_path) == run.method.health().num_rollouts_counted
    assert run.iteration == result.iteration == read_lines(tmp_path / "metrics.jsonl")[-1]["iteration"]


def test_workers_that_hang_are_replaced_and_one_that_is_late_is_not(tmp_path, monkeypatch):
    """Iterations wait for learner and generator, and no round is lost by that; they do not wait for an actor."""
    monkeypatch.setattr(watch, "STALL_S", 6.0)
    frozen, played, errors, said = {}, {"generator": [], "learner": []}, [], []

    def bounded(slot, stall_s):
        """Let it hang after that time; a bound holds from the end of a round on."""
        monkeypatch.setattr(watch, "STALL_S", stall_s)
        until = slot.num_rollouts + 2
        while slot.num_rollouts < until:
            yield

    def freeze(run):
        method = run.method
        for name in ("generator", "learner"):
            yield from all_there(run, 4, frozen.values())
            frozen[name] = send(run, name, signal.SIGSTOP)
        yield from all_there(run, 4, frozen.values())
        errors.append({name: actor.last_error for name, actor in workers_of(run).items()})
        assert method.health().num_rollouts_refused == 0
        incarnations = [actor.incarnation for actor in workers_of(run).values()]
        assert incarnations == [0, 0, 1, 1]

        slot, _ = method._pool
        yield from bounded(slot, 600.0)  # however long these iterations take, it is only late
        late = send(run, "rollout-0", signal.SIGSTOP)
        while not slot.late:  # iterations go on without it
            yield
        said.extend(method.health().warnings)
        for _ in range(6):  # what it plays is too old by then
            yield
        send(run, "rollout-0", signal.SIGCONT)
        while slot.late or not method.health().num_rollouts_refused:
            yield
        assert workers_of(run)["rollout-0"].incarnation == 0
        yield from bounded(slot, 6.0)
        frozen["rollout-0"] = send(run, "rollout-0", signal.SIGSTOP)
        assert frozen["rollout-0"] == late
        yield from all_there(run, 1, [late])
        errors.append({name: actor.last_error for name, actor in workers_of(run).items()})

    def look(run):
        for name in set(frozen) & set(played):
            if workers_of(run)[name].incarnation == 0:
                method = run.method
                batch = method._current.batch if method._current is not None else ()
                on_the_way = len(method._pending) + len(batch)
                played[name].append((run.iteration, on_the_way, len(method._pool.rounds)))

    run, result = run_cluster(tmp_path, story=freeze, on_beat=look)
    assert result.reason == "interrupted"
    for name in played:
        # All that the policy lag allows was played: two rollouts wait for the worker, and two for the next iteration.
        assert played[name][-1][1:] == (4, 0)
        assert len({iteration for iteration, _, _ in played[name]}) <= 2
    (first, last), hung = errors, r"no progress for \d+ s"
    assert {name for name, error in first.items() if error} == {"generator", "learner"}
    assert all(re.match(hung, last[name]) for name in frozen)
    assert said == ["rollout-0: late; updates go on without"]
    assert not any(is_alive(pid) for pid in frozen.values())
    assert_all_updates_are_there(tmp_path)
    # The refused one is left out, unless a later one covers it.
    assert num_counted(tmp_path) - run.method.health().num_rollouts_counted in (0, 1)


def lost_object():
    """A reference to what went with its machine."""

    def lost():
        raise ObjectLostError("ab" * 28, "", "")

    return ray.remote(lost).options(num_cpus=0, max_retries=0).remote()


def test_what_is_lost_or_cannot_be_mended(monkeypatch):
    """Each time the method says so in a line and could go on, were it not for that."""
    raylet = SimpleNamespace(silent=False)
    method = RaySelfPlay(tiny_config(), ClusterOptions(num_actors=1), raylet=raylet)

    def learn(num):
        until = method.iteration + num
        while method.iteration < until:
            method.step()

    def fails(kind, said, what):
        with pytest.raises(kind) as error:
            what()
        assert_one_line(str(error.value).strip().splitlines()[-1], said)

    @contextmanager
    def replaced(name, value):
        """Give rounds this value, also after an iteration that was on its way has handed out another."""
        hand_out, kept = method._hand_out, [getattr(method, name)]

        def hand_out_and_replace(**changes):
            hand_out(**changes)
            kept[0] = getattr(method, name)
            setattr(method, name, value)

        method._hand_out = hand_out_and_replace
        setattr(method, name, value)
        yield
        method._hand_out = hand_out
        setattr(method, name, kept[0])

    try:
        method.start()
        learn(2)
        raylet.silent = True  # then nobody is called hung, however short the bound
        with monkeypatch.context() as patch:
            patch.setattr(watch, "STALL_S", 0.0)
            learn(2)
        learn(3)  # each worker has ended a call since then: the usual bound holds
        raylet.silent = False
        # The driver's node has copies of what the next workers begin with.
        while None in method._copies.values():
            method.step()

        state, method._generator.state = method._generator.state, lost_object()
        fails(StateLostError, "newest state is lost", method.state)
        method._generator.state = state

        with replaced("_snapshot", lost_object()):  # its actor is not to blame
            fails(StateLostError, "goes back to its newest checkpoint", lambda: learn(100))
        weights = ray.get(method._weights)
        bob = {name: np.full_like(array, np.nan) for name, array in weights.bob.items()}
        with replaced("_weights", ray.put(replace(weights, bob=bob))):
            fails(PolicyError, "is not finite", lambda: learn(100))
        learn(1)

        # As when the machine of all actors loses power before the learner has got what it held.
        ask, lost = RaySelfPlay._ask, []

        def lose_batch(method, worker, batch):
            if worker is method._learner and not lost:
                lost.extend(batch)
                batch[:] = [replace_rollout(each) for each in batch]
            ask(method, worker, batch)

        def replace_rollout(each):
            each.rollout = lost_object()
            return each

        monkeypatch.setattr(RaySelfPlay, "_ask", lose_batch)
        learn(2)
        counted = ray.get(method._learner.state)["counted"]
        num_played = sum(int(highest) + 1 for _, _, highest in counted)
        assert method.health().num_rollouts_counted == num_played - len(lost)
        workers = method._learner, method._generator
        assert [each.watch.incarnation for each in workers] == [0, 0]
        assert method._pool.next_incarnation == 1

        monkeypatch.setattr(self_play, "MAX_ATTEMPTS", 2)
        restart = RemoteWorker.restart

        def kill():
            os.kill(next(each.pid for each in method.health().actors if each.name == "learner"), signal.SIGKILL)

        monkeypatch.setattr(RemoteWorker, "restart", lambda worker, error: (restart(worker, error), kill())[0])
        kill()
        fails(WorkersError, "2 times in a row the learner failed", lambda: learn(5))
    finally:
        method.close()


@pytest.mark.parametrize(
    ("device", "there", "asked"), [("cpu", 2.0, 0), ("cuda", 0.0, 1), ("auto", 0.0, 0), ("auto", 2.0, 1)]
)
def test_the_learner_asks_for_a_gpu(monkeypatch, device, there, asked):
    monkeypatch.setattr(ray, "cluster_resources", lambda: {"CPU": 8.0} | ({"GPU": there} if there else {}))
    assert num_gpus(device) == asked


@pytest.mark.skipif(cuda.is_available(), reason="asking for CUDA is no mistake on a machine that has it")
def test_a_learner_that_cannot_start_is_one_line(monkeypatch):
    monkeypatch.setattr(self_play, "num_gpus", lambda device: 0)  # Ray would wait for one
    learner = tiny_config().learner.model_copy(update={"device": "cuda"})
    method = RaySelfPlay(tiny_config().model_copy(update={"learner": learner}), ClusterOptions(num_actors=1))
    with pytest.raises(ConfigError) as error, explaining_ray_errors():
        method.start()
    method.close()
    assert_one_line(error.value, "learner.device", "no CUDA device", "learner.device=cpu")


def test_actors_that_wait_for_a_core_do_not_end_the_run(tmp_path, monkeypatch):
    """However many they are, and however often they are started anew."""
    monkeypatch.setattr(actor_pool, "START_GRACE_S", 0.5)
    monkeypatch.setattr(actor_pool, "RESTART_S", 0.1)
    monkeypatch.setattr(self_play, "MAX_FAILED_ROUNDS", 1)
    warnings, slots, incarnations = set(), set(), set()

    def hurry(run):
        while len(slots) < 7:
            yield
            for slot in run.method._pool:
                slot.may_start_s = min(slot.may_start_s, 1.0)
            slots.update(run.method._pool)
            incarnations.update(actor.incarnation for actor in run.method.health().actors)
            warnings.update(run.method.health().warnings)

    _, result = run_cluster(tmp_path, story=hurry, num_actors=3, threads=3)
    assert result.reason == "interrupted"
    assert "2 of 3 rollout actors wait for a free core" in warnings
    assert incarnations == {0}  # none of them counts as replaced


def test_a_raylet_that_is_frozen_is_silent_and_one_that_stays_so_is_given_up(monkeypatch):
    monkeypatch.setattr(watch, "SILENT_S", 1.0)
    pid = next(pid for pid, role in descendants(os.getpid()).items() if role == "raylet")
    lost = []

    def wait_until(holds):
        deadline_s = time.monotonic() + 60.0
        while not holds() and time.monotonic() < deadline_s:
            time.sleep(0.05)
        assert holds()

    with RayletWatch(lost.append) as raylet:
        wait_until(lambda: raylet.answers)
        os.kill(pid, signal.SIGSTOP)
        try:
            wait_until(lambda: raylet.silent)
            os.kill(pid, signal.SIGCONT)
            wait_until(lambda: not raylet.silent)
            assert lost == []
            monkeypatch.setattr(watch, "LOST_S", 2.0)
            os.kill(pid, signal.SIGSTOP)
            wait_until(lambda: lost)
        finally:
            os.kill(pid, signal.SIGCONT)
    (reason,) = lost
    assert "has not answered for " in reason


def test_a_worker_computes_with_one_thread_and_looks_for_no_window():
    def look():
        import sys

        before = sorted({"numpy", "torch", "mujoco"} & sys.modules.keys())
        import service.cluster.ray_actors  # noqa: F401  as unpickling an actor does

        return before, {name: os.environ.get(name) for name in WORKER_VARIABLES}, "mujoco.glfw" in sys.modules

    assert ray.get(ray.remote(num_cpus=0)(look).remote()) == ([], WORKER_VARIABLES, False)
