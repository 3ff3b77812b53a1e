"""The cluster runner on a real Ray: the same experiment as the local one, and whoever is killed is replaced."""

import os
import re
import signal
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import ray
from ray.exceptions import ObjectLostError
from torch import cuda

from benchmarks.processes import descendants
from service.base.errors import DivergedError
from service.cluster import watch
from service.cluster.ray_actors import NICENESS
from service.cluster.ray_connection import ClusterOptions, connected
from service.cluster.ray_runtime import RayRuntime
from service.cluster.remote_worker import RemoteWorker
from service.cluster.self_play import MAX_FAILED_ROUNDS, RaySelfPlay, num_gpus
from service.cluster.watch import RayletWatch
from service.cluster.worker_variables import WORKER_VARIABLES
from service.methods.method import StateLostError, WorkersError
from service.runs.run import Run
from service.runs.train import open_run
from service.store.checkpoints import CheckpointStore
from service.store.run_directory import RunDirectory
from tests.runs.runs import FullForAWhile, assert_one_line, is_alive, newest, play, read_lines, tiny_config

TOGETHER = ("learner/", "alice/", "bob/", "generator/")


@pytest.fixture(scope="module", autouse=True)
def cluster():
    """A Ray of four logical cores, for all tests of this file."""
    with connected(None, num_cpus=4):
        yield


def run_cluster(path, config=None, *, num_actors=2, resume=False, on_iteration=None, on_beat=None):
    """To the end; returns the run, closed, and how it ended."""
    directory = RunDirectory(path)
    runtime = RayRuntime(ClusterOptions(num_actors=num_actors))
    run = open_run(config or tiny_config(), directory, resume=resume, runtime=runtime)
    try:
        result = run.run(
            lambda metrics: on_iteration(run, metrics) if on_iteration else None,
            lambda: on_beat(run) if on_beat else None,
        )
        return run, result
    finally:
        run.close()
        directory.close()


def pid_of(run, name):
    return next(actor.pid for actor in run.method.health().actors if actor.name == name)


def kill(run, name):
    os.kill(pid_of(run, name), signal.SIGKILL)


def ids(path):
    """(actor, incarnation, highest sequence) of the rollouts that the newest checkpoint counts."""
    return newest(path).arrays["learner/counted"].tolist()


def test_one_actor_plays_and_learns_what_the_local_runner_does(tmp_path):
    config = tiny_config(total_env_steps=1200)
    play(tmp_path / "local", config)
    run_cluster(tmp_path / "ray", config, num_actors=1)
    local, cluster = (read_lines(tmp_path / name / "metrics.jsonl") for name in ("local", "ray"))
    assert len(cluster) >= 6  # with replayed goals and past opponents
    goals = [read_lines(tmp_path / name / "goals.jsonl") for name in ("local", "ray")]
    assert goals[1] == goals[0][: len(goals[1])]
    # Iteration i + 1 of the local runner records the update on the rollout of iteration i, here it is the same record.
    for index in range(min(len(cluster), len(local) - 1)):
        played = {name: value for name, value in local[index].items() if name.startswith(("alice/", "bob/"))}
        assert {name: cluster[index][name] for name in played} == played
        assert cluster[index]["env_steps"] == local[index]["env_steps"]
        learned = {name: value for name, value in local[index + 1].items() if name.startswith("learner/")}
        assert {name: cluster[index][name] for name in learned} == learned
        others = {name for name in local[index] if not name.startswith("learner/")}
        assert set(cluster[index]) == others | set(learned) | {"time/learn_s"}


def test_worlds_are_shared_out_and_every_rollout_counts_once(tmp_path):
    seen, told = [], FullForAWhile("ray")

    def look(run, metrics):
        seen.append(metrics)
        told(run, metrics)

    run, result = run_cluster(tmp_path, tiny_config(total_env_steps=1500), num_actors=3, on_iteration=look)
    told.check()
    assert result.reason == "finished"
    assert run.method._pool.num_worlds == 8
    health = run.method.health()
    assert health.num_rollouts_refused == 0
    counted = sum(highest + 1 for _, _, highest in ids(tmp_path))
    assert counted == health.num_rollouts_counted
    assert max(m["learner/max_policy_lag"] for m in seen) <= 2
    assert np.mean([m["learner/policy_lag"] for m in seen]) <= 1
    assert [m["learner/version"] for m in seen] == list(range(1, len(seen) + 1))
    assert newest(tmp_path).meta["env_steps"] == result.num_env_steps == seen[-1]["env_steps"]


def test_a_checkpoint_belongs_to_no_topology_and_no_runner(tmp_path):
    _, first = play(tmp_path, tiny_config(total_env_steps=600))  # with a pending rollout
    _, second = run_cluster(tmp_path, tiny_config(total_env_steps=1200), num_actors=3, resume=True)
    _, third = run_cluster(tmp_path, tiny_config(total_env_steps=1800), num_actors=1, resume=True)
    _, last = play(tmp_path, tiny_config(total_env_steps=2400), resume=True)
    steps = [result.num_env_steps for result in (first, second, third, last)]
    assert all(result.reason == "finished" for result in (first, second, third, last))
    assert steps == sorted(steps)
    rows = read_lines(tmp_path / "metrics.jsonl")
    assert [row["iteration"] for row in rows] == list(range(1, len(rows) + 1))
    assert all(row.get("learner/non_finite_steps", 0.0) == 0.0 for row in rows)
    versions = [row["learner/version"] for row in rows if "learner/version" in row]
    assert versions == list(range(1, len(versions) + 1))  # nobody lost or repeated an update
    assert {incarnation for _, incarnation, _ in ids(tmp_path)} == {0, 1, 2, 3}  # one for each process


def test_whoever_is_killed_is_replaced_and_nobody_else(tmp_path, monkeypatch):
    """Each save takes a minute, by the clock that workers are judged by, and so does the start of each successor."""
    strikes = [["learner"], ["rollout-1", "generator"], ["rollout-1", "learner", "generator"]]
    killed, since, lost_s, incarnations = [], [], [0.0], {}
    monkeypatch.setattr(watch, "time", SimpleNamespace(monotonic=lambda: time.monotonic() + lost_s[0]))

    def lose_a_minute(function):
        def slow(*args):
            lost_s[0] += 60.0
            return function(*args)

        return slow

    for kind, name in ((Run, "_save"), (RemoteWorker, "wait_ready")):
        monkeypatch.setattr(kind, name, lose_a_minute(getattr(kind, name)))

    def strike(run, metrics):
        """Some, others, then all at once; six iterations with everybody there end the run."""
        pids = [pid_of(run, name) for name in ("rollout-0", "rollout-1", "learner", "generator")]
        if None in pids or set(pids) & set(killed):
            return
        since.append(metrics["iteration"])
        if len(since) < 6:  # each has some rollouts or updates
            return
        since.clear()
        if not strikes:
            incarnations.update({actor.name: actor.incarnation for actor in run.method.health().actors})
            run.request_stop()
            return
        for name in strikes.pop(0):
            killed.append(pid_of(run, name))
            os.kill(killed[-1], signal.SIGKILL)

    run, result = run_cluster(tmp_path, tiny_config(total_env_steps=10**9), on_iteration=strike)
    assert result.reason == "interrupted"
    assert len(killed) == 6
    rows = read_lines(tmp_path / "metrics.jsonl")
    assert [row["learner/version"] for row in rows] == list(range(1, len(rows) + 1))  # no update lost or made twice
    assert (np.diff([row["env_steps"] for row in rows]) > 0).all()
    assert lost_s[0] >= 60.0 * 6
    assert incarnations == {"rollout-0": 0, "rollout-1": 2, "learner": 2, "generator": 2}  # each as often as killed
    counted = ids(tmp_path)
    assert {(actor, incarnation) for actor, incarnation, _ in counted} == {(0, 0), (1, 0), (1, 1), (1, 2)}
    # Not one of the rollouts that the actors handed over is missing.
    assert sum(highest + 1 for _, _, highest in counted) == run.method.health().num_rollouts_counted
    assert run.iteration == result.iteration == rows[-1]["iteration"]


def test_updates_go_on_without_an_actor_that_is_late_and_one_that_hangs_is_replaced(tmp_path, monkeypatch):
    monkeypatch.setattr(watch, "STALL_S", 10.0)
    late, frozen, said = [], [], []

    def freeze(run, metrics):
        pid, slot = pid_of(run, "rollout-0"), run.method._pool._slots[0]
        if metrics["iteration"] < 4 or pid is None or pid_of(run, "rollout-1") is None:
            return
        if not late:
            late.append((pid, slot.incarnation, metrics["iteration"]))
            os.kill(pid, signal.SIGSTOP)
        elif slot.late and not frozen:  # iterations have gone on without it
            said.append(run.method.health().warnings)
            if metrics["iteration"] >= late[0][2] + 6:  # what it plays is too old by then
                os.kill(pid, signal.SIGCONT)
                frozen.append(None)
        elif frozen == [None] and not slot.late and slot.num_rollouts:
            frozen[:] = [pid]
            os.kill(pid, signal.SIGSTOP)
        elif frozen and frozen[0] and pid != frozen[0]:
            run.request_stop()

    run, result = run_cluster(tmp_path, tiny_config(total_env_steps=10**9), on_iteration=freeze)
    assert result.reason == "interrupted"
    assert said
    assert "rollout-0: late; updates go on without" in said[-1]
    assert re.match(r"rollout-0: no progress for 1\d s", str(run.method.health().last_error))
    assert not is_alive(frozen[0])
    assert late[0][:2] == (frozen[0], 0)  # late it was not replaced, but when it was frozen for good
    health = run.method.health()
    assert health.num_rollouts_refused >= 1  # it came too late
    counted = sum(highest + 1 for _, _, highest in ids(tmp_path))
    assert counted - health.num_rollouts_counted in (0, 1)  # the refused one is left out, unless a later one covers it


def test_no_round_notices_workers_that_are_frozen(tmp_path, monkeypatch):
    """Iterations wait until another takes its place; no actor is replaced, no rollout is lost or counted twice."""
    monkeypatch.setattr(watch, "STALL_S", 10.0)
    frozen, since, errors, played = {}, [], [], {"generator": [], "learner": []}
    names = list(played)

    def worker(run, name):
        return run.method._generator if name == "generator" else run.method._learner

    def freeze(run, metrics):
        """One after the other, each when all have been there for some iterations."""
        since.append(metrics["iteration"])
        waited_for = [name for name in frozen if worker(run, name).incarnation == 0]
        if waited_for or any(actor.pid is None for actor in run.method.health().actors):
            since.clear()
        if len(since) < 4:
            return
        since.clear()
        errors.append({actor.name: actor.last_error for actor in run.method.health().actors})
        if not names:
            run.request_stop()
            return
        name = names.pop(0)
        frozen[name] = pid_of(run, name)
        os.kill(frozen[name], signal.SIGSTOP)

    def look(run):
        for name in frozen:
            if worker(run, name).incarnation == 0:
                played[name].append((run.iteration, run.method._slots.num_taken, len(run.method._slots._began)))

    run, result = run_cluster(tmp_path, tiny_config(total_env_steps=10**9), on_iteration=freeze, on_beat=look)
    assert result.reason == "interrupted"
    before, after_first, after_both = errors
    assert set(before.values()) == {None}
    assert [name for name, error in after_first.items() if error] == ["generator"]
    assert {name for name, error in after_both.items() if error} == {"generator", "learner"}
    for name, pid in frozen.items():
        # All that the policy lag allows was played: two rollouts wait for the worker, and two for the next iteration.
        assert played[name][-1][1:] == (4, 0)
        assert len({iteration for iteration, _, _ in played[name]}) <= 2
        assert not is_alive(pid)
        assert re.match(r"no progress for 1\d s", after_both[name])
    health = run.method.health()
    assert health.num_rollouts_refused == 0
    counted = ids(tmp_path)
    assert {incarnation for _, incarnation, _ in counted} == {0}
    assert sum(highest + 1 for _, _, highest in counted) == health.num_rollouts_counted
    rows = read_lines(tmp_path / "metrics.jsonl")
    assert [row["iteration"] for row in rows] == list(range(1, len(rows) + 1))
    assert [row["learner/version"] for row in rows] == list(range(1, len(rows) + 1))


def test_learners_that_die_before_the_run_has_begun_and_while_they_start_lose_nothing(tmp_path, monkeypatch):
    ready, doomed, struck = RemoteWorker.wait_ready, ["learner"], []

    def kill_some(worker):
        """Once its process is up, and before it has its state."""
        if worker.name in doomed:
            doomed.remove(worker.name)
            struck.append(ray.get(worker.handle.ping.remote()).pid)
            os.kill(struck[-1], signal.SIGKILL)
        ready(worker)

    monkeypatch.setattr(RemoteWorker, "wait_ready", kill_some)

    def strike(run, metrics):
        if metrics["iteration"] == 1:
            assert newest(tmp_path).step == 0  # of the learner that came after the first one
        elif metrics["iteration"] == 4:
            assert pid_of(run, "learner") not in struck
            doomed.extend(["learner", "learner"])
            kill(run, "learner")
        elif metrics["iteration"] >= 8:
            run.request_stop()

    run, result = run_cluster(tmp_path, tiny_config(total_env_steps=10**9), num_actors=1, on_iteration=strike)
    assert result.reason == "interrupted"
    assert len(struck) == 3
    assert run.method._learner.incarnation == 4
    rows = read_lines(tmp_path / "metrics.jsonl")
    assert [row["learner/version"] for row in rows] == list(range(1, len(rows) + 1))
    assert sum(highest + 1 for _, _, highest in ids(tmp_path)) == run.method.health().num_rollouts_counted


def test_a_stop_ends_it_at_once_and_saved(tmp_path):
    torch, nice, asked = {}, {}, []

    def look_and_ask(run, metrics):
        actors = run.method.health().actors
        if metrics["iteration"] >= 5 and not any(actor.pid is None for actor in actors):  # all have unpickled weights
            for actor in actors:
                torch[actor.name] = "libtorch" in Path(f"/proc/{actor.pid}/maps").read_text()
                nice[actor.name] = os.getpriority(os.PRIO_PROCESS, actor.pid)
            asked.append(metrics["iteration"])
            run.request_stop()

    config = tiny_config(total_env_steps=10**9, checkpoint_interval=10**6)
    _, result = run_cluster(tmp_path, config, num_actors=1, on_iteration=look_and_ask)
    (iteration,) = asked
    assert (result.reason, result.iteration) == ("interrupted", iteration)  # no other round was waited for
    assert CheckpointStore(tmp_path / "checkpoints", keep=1).steps()[-1] == iteration
    # Only the learner has torch: an actor with it takes three times the memory and comes up three times as slowly.
    assert torch == {"rollout-0": False, "learner": True, "generator": False}
    # Who computes gives way to who answers.
    answers = nice.pop("generator")
    assert set(nice.values()) == {min(19, answers + NICENESS)}
    assert answers < 19


def test_a_worker_computes_with_one_thread_and_looks_for_no_window():
    def look():
        import sys

        before = sorted({"numpy", "torch", "mujoco"} & sys.modules.keys())
        import service.cluster.ray_actors  # noqa: F401  as unpickling an actor does

        return before, {name: os.environ.get(name) for name in WORKER_VARIABLES}, "mujoco.glfw" in sys.modules

    elsewhere = {"OPENBLAS_NUM_THREADS": "7", "MUJOCO_GL": "glfw"}
    task = ray.remote(num_cpus=0, runtime_env={"env_vars": elsewhere})(look)
    assert ray.get(task.remote()) == ([], WORKER_VARIABLES, False)


def test_a_learner_that_dies_of_every_batch_ends_the_run_with_one_line(tmp_path, monkeypatch):
    monkeypatch.setattr("service.cluster.self_play.MAX_ATTEMPTS", 2)

    def strike(run, metrics):
        if metrics["iteration"] >= 3:
            real = run.method._learner.restart

            def restart_and_strike(why):
                real(why)
                os.kill(pid_of(run, "learner"), signal.SIGKILL)

            run.method._learner.restart = restart_and_strike
            kill(run, "learner")

    with pytest.raises(WorkersError, match=r"2 times in a row the learner failed") as error:
        run_cluster(tmp_path, tiny_config(total_env_steps=10**9), num_actors=1, on_iteration=strike)
    assert "\n" not in str(error.value)


def test_a_policy_that_diverges_ends_the_run_with_how_to_go_on(tmp_path):
    """Parameters that are not finite, as a learning rate far too high would make them."""

    def spoil(run, metrics):
        if metrics["iteration"] == 3:
            weights = ray.get(run.method._weights)
            nans = {name: np.full_like(array, np.nan) for name, array in weights.bob.items()}
            run.method._weights = ray.put(replace(weights, bob=nans))

    with pytest.raises(DivergedError, match=r"resume with lower learning rates") as error:
        run_cluster(tmp_path, tiny_config(total_env_steps=10**9), num_actors=1, on_iteration=spoil)
    assert "\n" not in str(error.value)


def lost_object():
    """A reference to what went with its machine."""

    def lost():
        raise ObjectLostError("ab" * 28, "", "")

    return ray.remote(lost).options(num_cpus=0, max_retries=0).remote()


def test_a_snapshot_lost_with_its_machine_sends_the_run_back(tmp_path):
    """No other round could be played: its actor is not to blame."""

    def lose(run, metrics):
        if metrics["iteration"] == 3:
            run.method._snapshot = lost_object()

    with pytest.raises(StateLostError, match=r"goes back to its newest checkpoint") as error:
        run_cluster(tmp_path, tiny_config(total_env_steps=10**9), num_actors=1, on_iteration=lose)
    assert "\n" not in str(error.value)


def test_rollouts_that_are_all_lost_with_their_machine_are_not_learned_from(tmp_path, monkeypatch):
    """As when the machine of all actors loses power before the learner has got what it held."""
    ask_learner, losing, lost = RaySelfPlay._ask_learner, [], []

    def lose_some(run, iteration):
        if losing:
            losing.clear()
            lost.extend(iteration.batch)
            iteration.batch[:] = [replace(each, rollout=lost_object()) for each in iteration.batch]
        ask_learner(run, iteration)

    monkeypatch.setattr(RaySelfPlay, "_ask_learner", lose_some)

    def look(run, metrics):
        if metrics["iteration"] == 3:
            losing.append(True)
        elif metrics["iteration"] == 6:
            run.request_stop()

    run, result = run_cluster(tmp_path, tiny_config(total_env_steps=10**9), on_iteration=look)
    assert result.reason == "interrupted"
    assert len(lost) >= 2
    assert run.method._learner.incarnation == run.method._generator.incarnation == 0
    rows = read_lines(tmp_path / "metrics.jsonl")
    assert [row["learner/version"] for row in rows] == [1, 2, 3, 4, 5, 6]
    num_played = sum(highest + 1 for _, _, highest in ids(tmp_path))
    assert run.method.health().num_rollouts_counted == num_played - len(lost)
    method = run.method
    for _ in range(2):  # the first look takes the answer to a question of before
        method._clock.now += 1000.0
        assert method._learner.watch.look() is method._generator.watch.look() is None  # neither is still waited for


@pytest.mark.parametrize(
    ("device", "there", "asked"), [("cpu", 2.0, 0), ("cuda", 0.0, 1), ("auto", 0.0, 0), ("auto", 2.0, 1)]
)
def test_the_learner_asks_for_a_gpu(monkeypatch, device, there, asked):
    monkeypatch.setattr("ray.cluster_resources", lambda: {"CPU": 8.0} | ({"GPU": there} if there else {}))
    assert num_gpus(device) == asked


@pytest.mark.skipif(cuda.is_available(), reason="asking for CUDA is no mistake on a machine that has it")
def test_a_learner_that_cannot_start_is_one_line(tmp_path, monkeypatch):
    monkeypatch.setattr("service.cluster.self_play.num_gpus", lambda device: 0)  # Ray would wait for one
    learner = tiny_config().learner.model_copy(update={"device": "cuda"})
    with pytest.raises(WorkersError) as error:
        run_cluster(tmp_path, tiny_config().model_copy(update={"learner": learner}))
    assert_one_line(error.value, "learner.device", "no CUDA device", "learner.device=cpu")


def test_actors_that_wait_for_a_core_do_not_end_the_run(tmp_path):
    """However many they are, and however often they are started anew."""
    num_replaced = []

    def hurry(run, metrics):
        num_replaced.append(sum(slot.incarnation for slot in run.method._pool))
        for slot in run.method._pool:
            if not slot.alive:
                slot.may_start_s = 0.01

    _, result = run_cluster(tmp_path, tiny_config(total_env_steps=600), num_actors=26, on_iteration=hurry)
    assert result.reason == "finished"
    assert num_replaced[-1] > MAX_FAILED_ROUNDS


def test_a_raylet_that_is_frozen_is_silent_and_one_that_stays_so_is_given_up(monkeypatch):
    monkeypatch.setattr("service.cluster.watch.SILENT_S", 1.0)
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
            monkeypatch.setattr("service.cluster.watch.LOST_S", 2.0)
            os.kill(pid, signal.SIGSTOP)
            wait_until(lambda: lost)
        finally:
            os.kill(pid, signal.SIGCONT)
    (reason,) = lost
    assert reason.startswith("Ray's process for this machine, the raylet, has not answered for ")


def test_a_state_lost_before_it_was_saved_sends_the_run_back(tmp_path):
    def lose(run, metrics):
        if metrics["iteration"] == 3:
            run.method._generator.state = lost_object()

    config = tiny_config(total_env_steps=10**9, checkpoint_interval=3)
    with pytest.raises(StateLostError, match=r"newest state is lost .* goes back to its newest checkpoint") as error:
        run_cluster(tmp_path, config, num_actors=1, on_iteration=lose)
    assert "\n" not in str(error.value)
