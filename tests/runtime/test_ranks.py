"""A learner of two ranks on a real Ray: whoever dies or hangs, the ranks are started again, and nothing is lost."""

import os
import signal
from dataclasses import replace

import pytest
import ray
from ray.exceptions import ObjectLostError

from service.config import parse_config
from service.errors import ConfigError
from service.io.run_directory import RunDirectory
from service.runtime import watch
from service.runtime.cluster import ClusterRun
from service.runtime.learner_group import check_room, num_gpus
from service.runtime.local import LocalRun
from service.runtime.ray_connection import ClusterOptions, connected
from service.runtime.resuming import resumed_config
from service.runtime.runner import ClusterError
from tests.runtime.runs import TREE, assert_one_line, is_alive, newest, play, read_lines, tiny_config, write_yaml


@pytest.fixture(scope="module")
def cluster():
    """A Ray of four logical cores, for all tests of this file."""
    with connected(None, num_cpus=4):
        yield


def two_ranks(**run):
    learner = TREE["learner"] | {"num_learners": 2}
    return parse_config(TREE | {"learner": learner, "run": TREE["run"] | run}, where="a test")


def run_cluster(path, config, *, resume=False, on_iteration=None):
    """To the end with two actors; returns the run, closed, and how it ended."""
    directory = RunDirectory(path)
    directory.claim(resume=resume)
    run = ClusterRun(config, directory, ClusterOptions(num_actors=2), resume=resume)
    try:
        return run, run.run(lambda metrics: on_iteration(run, metrics) if on_iteration else None)
    finally:
        run.close()
        directory.close()


def pids(run):
    return [location.pid for location in run._learner.locations]


def test_a_run_survives_ranks_that_die_and_hang_and_rollouts_that_are_all_lost(cluster, tmp_path, monkeypatch):
    """The last one is as when the machine of all actors loses power before the ranks have got what it held."""
    monkeypatch.setattr(watch, "STALL_S", 10.0)
    strikes = [(0, signal.SIGKILL), (1, signal.SIGSTOP), None]
    struck, since, losing, lost = [], [], [], []
    ask_learner = ClusterRun._ask_learner

    def lose():
        raise ObjectLostError("ab" * 28, "", "")

    def lose_some(run, iteration):
        if losing:
            losing.clear()
            lost.extend(iteration.batch)
            gone = ray.remote(lose).options(num_cpus=0, max_retries=0)
            iteration.batch[:] = [replace(each, rollout=gone.remote()) for each in iteration.batch]
        ask_learner(run, iteration)

    monkeypatch.setattr(ClusterRun, "_ask_learner", lose_some)

    def strike(run, metrics):
        """One after the other, each with some updates in between."""
        since.append(metrics["iteration"])
        if len(since) < 3:
            return
        since.clear()
        struck.append((pids(run), run.health().last_error))
        if not strikes:
            run.request_stop()
        elif (how := strikes.pop(0)) is None:
            losing.append(True)
        else:
            rank, sign = how
            os.kill(pids(run)[rank], sign)

    run, result = run_cluster(tmp_path, two_ranks(total_env_steps=10**9), on_iteration=strike)
    assert result.reason == "interrupted"
    assert run._learner.incarnation == 3  # once for each, though both ranks say that rollouts are lost
    everybody = [pid for group, _ in struck for pid in group]
    assert len(set(everybody)) == 8
    assert [pid for pid in everybody if is_alive(pid)] == []  # all of a group are ended, whoever it was
    first, second, *_ = [error for _, error in struck]
    assert first is None
    assert_one_line(second, "learner: rank 0 on ", "died")
    assert_one_line(run.health().last_error, "learner: rank 1 on ", "no progress for 1")
    assert [status.name for status in run.health().actors] == ["learner-0", "learner-1", "generator"]
    rows = read_lines(tmp_path / "metrics.jsonl")
    assert [row["learner/version"] for row in rows] == list(range(1, len(rows) + 1))
    num_played = sum(highest + 1 for _, _, highest in newest(tmp_path).arrays["learner/counted"].tolist())
    assert len(lost) >= 2
    assert run.health().num_rollouts_counted == num_played - len(lost)
    assert run.health().num_rollouts_refused == 0


def test_the_number_of_ranks_may_change_at_every_resume(cluster, tmp_path):
    _, first = play(tmp_path, tiny_config(total_env_steps=600))  # with a pending rollout
    overrides = ["learner.num_learners=2", "run.total_env_steps=1200"]
    _, second = run_cluster(tmp_path, resumed_config(RunDirectory(tmp_path), overrides), resume=True)
    overrides = ["learner.num_learners=1", "run.total_env_steps=1800"]
    _, third = run_cluster(tmp_path, resumed_config(RunDirectory(tmp_path), overrides), resume=True)
    _, last = play(tmp_path, resumed_config(RunDirectory(tmp_path), ["run.total_env_steps=2400"]), resume=True)
    assert [result.reason for result in (first, second, third, last)] == ["finished"] * 4
    rows = read_lines(tmp_path / "metrics.jsonl")
    assert [row["iteration"] for row in rows] == list(range(1, len(rows) + 1))
    versions = [row["learner/version"] for row in rows if "learner/version" in row]
    assert versions == list(range(1, len(versions) + 1))
    assert all(row.get("learner/non_finite_steps", 0.0) == 0.0 for row in rows)


def test_more_ranks_than_cores_or_gpus_is_one_line(monkeypatch):
    monkeypatch.setattr("ray.cluster_resources", lambda: {"CPU": 4.0, "GPU": 1.0})
    check_room(1, "cuda", 0.0, 8)  # one learner takes what it gets, as ever
    check_room(3, "cpu", 1.0, 1)
    with pytest.raises(ClusterError) as error:
        check_room(4, "cpu", 1.0, 1)
    assert_one_line(error.value, "learner.num_learners = 4", "too few, 4", "fewer ranks")
    with pytest.raises(ClusterError) as error:
        check_room(2, "cuda", 1.0, 1)
    assert_one_line(error.value, "learner.num_learners = 2", "each rank takes a GPU", "has 1")


@pytest.mark.parametrize(
    ("device", "there", "asked"), [("cpu", 2.0, 0), ("cuda", 0.0, 1), ("auto", 0.0, 0), ("auto", 2.0, 1)]
)
def test_the_learner_asks_for_a_gpu(monkeypatch, device, there, asked):
    monkeypatch.setattr("ray.cluster_resources", lambda: {"CPU": 8.0} | ({"GPU": there} if there else {}))
    assert num_gpus(device, 1) == asked


def test_cores_of_ranks():
    learner = two_ranks().learner.model_copy(update={"num_threads": 3})
    assert ClusterOptions().rank_cpus(learner) == 3.0
    assert ClusterOptions(learner_cpus=0.5).rank_cpus(learner) == 0.5
    assert ClusterOptions().rank_cpus(tiny_config().learner) == 0.0


def test_the_local_runner_has_one_learner(tmp_path):
    with pytest.raises(ConfigError) as error:
        LocalRun(two_ranks(), RunDirectory(tmp_path / "run"))
    assert_one_line(error.value, "learner.num_learners = 2", "--runtime ray", "--set learner.num_learners=1")
    assert not (tmp_path / "run").exists()


def test_a_file_may_say_another_number_of_ranks_at_a_resume(tmp_path):
    play(tmp_path / "run", tiny_config(total_env_steps=100))
    tree = TREE | {"learner": TREE["learner"] | {"num_learners": 2}}
    resumed = resumed_config(RunDirectory(tmp_path / "run"), [], write_yaml(tmp_path / "two.yaml", tree))
    assert resumed.learner.num_learners == 2
    again = resumed_config(RunDirectory(tmp_path / "run"), ["learner.num_learners=1"], tmp_path / "two.yaml")
    assert again.learner.num_learners == 1


def test_a_file_that_says_nothing_of_ranks_leaves_them_as_they_are(tmp_path):
    write_yaml(tmp_path / "config.yaml", TREE | {"learner": TREE["learner"] | {"num_learners": 2}})
    resumed = resumed_config(RunDirectory(tmp_path), [], write_yaml(tmp_path / "one.yaml", TREE))
    assert resumed.learner.num_learners == 2


def test_a_batch_too_small_for_the_ranks_is_one_line():
    tree = TREE | {"learner": TREE["learner"] | {"num_learners": 3}}
    with pytest.raises(ConfigError) as error:
        parse_config(tree, where="a test")
    assert_one_line(error.value, "3 learners have 21 rows each", "alice", "use at most 2 learners")
