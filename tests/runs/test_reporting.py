"""What a run in one process tells while it goes on, and that only one process runs it."""

import json
import math
import signal
import threading
import time

import httpx
import numpy as np
import pytest

from service.base import lock
from service.base.errors import DivergedError, RunTakenError, StoreUnavailableError, TandemError
from service.base.lock import claim_epoch
from service.config import WorldConfig
from service.envs.batch import WorldBatch
from service.methods.self_play import LocalSelfPlay, SelfPlay
from service.registry.registry import Registry
from service.runs import report
from service.runs import run as runs_run
from service.runs import train as module
from service.runs.resuming import resumed_config
from service.runs.signals import InterruptError
from service.runs.train import UnfinishedError, publish_learned, train
from service.status.run_reader import open_reader
from service.status.server import StatusServer
from service.store import redis_writer, run_writer
from service.store.disk_reader import DiskReader
from service.store.redis_reader import RedisReader
from service.store.run_directory import RunDirectory
from service.store.run_writer import RunWriter
from tests.runs.runs import (
    PROCESSES,
    assert_one_line,
    assert_same_run,
    play,
    read_lines,
    tiny_config,
)
from tests.status.runs import BEARER, CLIENT, TOKEN
from tests.store.redis_server import RedisServer
from tests.store.stores import a_writer, wait_until

pytestmark = pytest.mark.usefixtures("default_signals")


@pytest.fixture(autouse=True)
def quick(monkeypatch, no_artifacts):
    monkeypatch.delenv("TANDEM_REDIS_URL", raising=False)
    monkeypatch.setattr(redis_writer, "TICK_S", 0.02)


@pytest.fixture
def redis(tmp_path, monkeypatch):
    killable = RedisServer(tmp_path / "redis")
    monkeypatch.setenv("TANDEM_REDIS_URL", killable.address.url)
    yield killable
    killable.close()


def run(tmp_path, config=None, *, resume=False, on_iteration=lambda metrics: None):
    directory = RunDirectory(tmp_path / "runs" / "cube")
    config = config or tiny_config(total_env_steps=400)
    return train(config, directory, tmp_path / "registry", resume=resume, on_iteration=on_iteration)


def status(tmp_path):
    return DiskReader(tmp_path / "runs").run("cube")


def test_a_run_whose_workers_start_for_long_is_alive(tmp_path, monkeypatch):
    start, seen = LocalSelfPlay.start, []

    def start_slowly(method, state=None):
        for _ in range(2):
            seen.append(status(tmp_path))
            method.on_wait()
        seen.append(status(tmp_path))
        start(method, state)

    monkeypatch.setattr(LocalSelfPlay, "start", start_slowly)
    monkeypatch.setattr(runs_run, "BEAT_S", 0.0)
    monkeypatch.setattr(run_writer, "STATUS_INTERVAL_S", 0.0)
    run(tmp_path)
    assert [each.state for each in seen] == ["starting"] * 3
    assert seen[0].heartbeat < seen[1].heartbeat < seen[2].heartbeat


def test_an_iteration_that_takes_long_is_alive_while_its_worlds_go_on(tmp_path, monkeypatch):
    """As one of a task may take minutes: its iteration has thousands of updates."""
    step, stood = LocalSelfPlay.step, []

    def step_slowly(method):
        before = status(tmp_path)
        time.sleep(0.1)  # many beats
        stood.append(status(tmp_path).heartbeat == before.heartbeat)

        def stepped():
            with WorldBatch(WorldConfig(), 1) as worlds:
                worlds.step(np.zeros((1, 4), np.float32))
            return status(tmp_path).heartbeat > before.heartbeat

        wait_until(stepped)
        return step(method)

    monkeypatch.setattr(LocalSelfPlay, "step", step_slowly)
    monkeypatch.setattr(report, "BEAT_S", 0.01)
    monkeypatch.setattr(run_writer, "STATUS_INTERVAL_S", 0.0)
    run(tmp_path)
    assert stood
    assert stood[0]  # nothing was stepped then: as where a run hangs


def test_a_run_tells_how_far_it_is_and_how_it_ended(tmp_path):
    seen = []
    done = run(tmp_path, on_iteration=lambda metrics: seen.append(status(tmp_path)))
    assert [each.state for each in seen] == ["running"] * len(seen)
    last = status(tmp_path)
    assert (last.state, last.run_id, last.name, last.runtime) == ("finished", "cube", "tiny", "local")
    assert (last.iteration, last.num_env_steps) == (done.iteration, done.num_env_steps)
    assert (last.policy_version, last.num_rollouts_counted) == (last.iteration - 1, last.iteration - 1)
    assert (last.published, last.last_error, last.warnings, last.stopping) == ("tiny@1", None, (), False)
    assert last.env_steps_per_s > 0
    assert [(each.name, each.state, each.num_rollouts) for each in last.actors] == [
        ("rollout-0", "alive", last.iteration)
    ]
    reader = DiskReader(tmp_path / "runs")
    assert len(reader.metrics("cube")) == last.iteration
    grid = reader.goals("cube")
    assert grid.num_cells >= len(grid.cells) > 0
    assert sum(cell.num_tries for cell in grid.cells) > 0

    seen.clear()  # a resumed run tells where it goes on, and what was published before
    config = resumed_config(RunDirectory(tmp_path / "runs" / "cube"), ["run.total_env_steps=600"])
    run(tmp_path, config, resume=True, on_iteration=lambda metrics: seen.append(status(tmp_path)))
    assert (seen[0].state, seen[0].iteration, seen[0].published) == ("running", last.iteration, "tiny@1")
    assert seen[0].started > last.started
    assert status(tmp_path).published == "tiny@2"


@pytest.mark.parametrize(("interval_s", "shown"), [(0.0, [1, 2, 3]), (3600.0, [1])])
def test_a_run_tells_its_grid_now_and_then(tmp_path, monkeypatch, interval_s, shown):
    monkeypatch.setattr(report, "GOALS_INTERVAL_S", interval_s)
    told = []
    monkeypatch.setattr(RunWriter, "goals", lambda writer, grid: told.append(grid.iteration))
    run(tmp_path, on_iteration=lambda metrics: "finished" if metrics["iteration"] == 3 else None)
    assert told == shown


def test_a_stop_request_ends_the_run_after_its_iteration_saved(tmp_path):
    def stop_at(iteration):
        def each(metrics):
            if metrics["iteration"] == iteration:
                DiskReader(tmp_path / "runs").request_stop("cube")
                assert status(tmp_path).stopping

        return each

    config = tiny_config(total_env_steps=1500)
    done = run(tmp_path, config, on_iteration=stop_at(3))
    assert (done.reason, done.iteration, done.version) == ("interrupted", 3, None)
    last = status(tmp_path)
    assert (last.state, last.iteration, last.stopping) == ("interrupted", 3, False)
    run(tmp_path, config, resume=True)  # the request was for the process that has ended
    assert status(tmp_path).state == "finished"
    play(tmp_path / "whole", config)
    assert_same_run(tmp_path / "runs" / "cube", tmp_path / "whole")  # telling changes nothing


def test_how_a_run_failed(tmp_path, monkeypatch):
    def fail(*_):
        raise DivergedError("a\nproblem")

    with monkeypatch.context() as patch:
        patch.setattr(RunDirectory, "record", fail)
        with pytest.raises(DivergedError):
            run(tmp_path)
    assert (status(tmp_path).state, status(tmp_path).last_error) == ("failed", "DivergedError: a problem")
    monkeypatch.setattr(module, "publish_run", fail)
    with pytest.raises(UnfinishedError):
        run(tmp_path, resume=True)
    assert_one_line(status(tmp_path).last_error, "saved, but not published: a problem", "--resume")


def test_a_resume_that_is_refused_leaves_what_the_run_has_come_to(tmp_path, monkeypatch):
    done = run(tmp_path)

    def refuse(*_, **__):
        raise TandemError("its primitives are gone")

    monkeypatch.setattr(module, "open_run", refuse)
    with pytest.raises(TandemError):
        run(tmp_path, resume=True)
    last = status(tmp_path)
    assert (last.state, last.last_error) == ("failed", "TandemError: its primitives are gone")
    assert (last.iteration, last.num_env_steps) == (done.iteration, done.num_env_steps)


def test_numbers_of_numpy_and_such_as_are_none_end_no_run(tmp_path, monkeypatch):
    measured = {"evaluation/mixed_success_last": np.float32(0.5), "evaluation/odd": math.nan}
    monkeypatch.setattr(SelfPlay, "measure", lambda self: measured)
    done = run(tmp_path)
    assert RunDirectory(tmp_path / "runs" / "cube").read_result()["evaluation"] == {"mixed_success_last": 0.5}
    assert Registry(tmp_path / "registry").manifest(str(done.version)).metrics["evaluation/mixed_success_last"] == 0.5


def test_a_run_is_published_beside_a_redis_that_is_away(tmp_path, monkeypatch):
    directory = RunDirectory(tmp_path / "runs" / "cube")
    train(tiny_config(), directory, tmp_path / "registry", publish=False, on_iteration=lambda metrics: None)
    monkeypatch.setenv("TANDEM_REDIS_URL", "redis://127.0.0.1:1/0")
    version = publish_learned(tmp_path / "runs" / "cube", tmp_path / "registry", metrics={})
    assert status(tmp_path).published == str(version) == "tiny@1"


def test_a_second_signal_is_an_interruption(tmp_path):
    def interrupt(metrics):
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGINT)

    with pytest.raises(InterruptError):
        run(tmp_path, on_iteration=interrupt)
    assert (status(tmp_path).state, status(tmp_path).last_error) == ("interrupted", "ended at once by SIGINT")


def test_totals_count_what_is_done_again_and_never_fall(tmp_path, monkeypatch):
    """A process that dies after its checkpoint: the next one makes some iterations a second time."""
    monkeypatch.setattr(run_writer, "STATUS_INTERVAL_S", 0.0)
    seen, config = [], tiny_config(total_env_steps=1500, checkpoint_interval=3)

    def die(metrics):
        seen.append(status(tmp_path))
        if metrics["iteration"] == 5:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(tmp_path, config, on_iteration=die)
    run(tmp_path, config, resume=True, on_iteration=lambda metrics: seen.append(status(tmp_path)))
    seen.append(status(tmp_path))
    steps = [each.num_env_steps for each in seen]
    assert steps != sorted(steps)  # it went back
    totals = [each.totals for each in seen]
    for name in ("iterations", "env_steps", "rollouts_counted", "rollouts_refused", "replacements"):
        counts = [getattr(each, name) for each in totals]
        assert counts == sorted(counts)
    assert totals[-1].iterations in (
        seen[-1].iteration + 1,
        seen[-1].iteration + 2,
    )  # of 4 and 5, as far as it was told
    assert totals[-1].env_steps > seen[-1].num_env_steps


def test_a_run_that_another_took_over_stops_at_once_and_leaves_its_status_alone(tmp_path, redis):
    """On another machine, whose file system gave the lock away: the epoch in the directory tells."""
    seen, path = [], tmp_path / "runs" / "cube"

    def take_over(metrics):
        seen.append(metrics["iteration"])
        if len(seen) == 3:
            claim_epoch(path)

    with pytest.raises(RunTakenError, match="was taken over by another process"):
        run(tmp_path, tiny_config(total_env_steps=10**9), on_iteration=take_over)
    assert len(seen) == 3
    assert (status(tmp_path).state, RedisReader(redis.address).run("cube").state) == ("running", "running")
    assert not (tmp_path / "registry").exists()


# --- one process -----------------------------------------------------------------------------------------------------


def test_a_second_process_is_refused_and_a_killed_one_has_vanished(tmp_path):
    path, reader = tmp_path / "runs" / "cube", DiskReader(tmp_path / "runs")
    other = PROCESSES.Process(target=run, args=(tmp_path, tiny_config(total_env_steps=10**9)))
    other.start()
    try:
        wait_until(lambda: path.exists() and reader.runs() and reader.run("cube").iteration > 0, within_s=600.0)
        assert reader.run("cube").state == "running"
        with pytest.raises(RunTakenError) as error:
            RunDirectory(path).claim(resume=True)
        assert_one_line(error.value, f"{path} is in use by process {other.pid}", "--run-dir")
    finally:
        other.kill()
        other.join()
    told = json.loads((path / "status.json").read_text())
    (path / "status.json").write_text(json.dumps(told | {"heartbeat": "2024-05-01T00:00:00Z"}))
    seen = status(tmp_path)  # a reader who has seen it alive does not care for dates
    assert (seen.state, "vanished" in seen.last_error) == ("interrupted", True)
    directory = RunDirectory(path)
    directory.claim(resume=True)  # the kernel has freed it
    directory.close()


def test_of_two_new_runs_at_once_one_begins(tmp_path, monkeypatch):
    monkeypatch.setattr(lock, "WAIT_S", 600.0)
    first, second = RunDirectory(tmp_path), RunDirectory(tmp_path)
    first.claim(resume=False)
    first.claim(resume=False)
    errors = []

    def claim():
        try:
            second.claim(resume=False)
        except TandemError as error:
            errors.append(error)

    waiting = threading.Thread(target=claim)
    waiting.start()
    time.sleep(0.1)  # it waits for the lock by now
    first.start(tiny_config())
    first.close()
    waiting.join()
    assert_one_line(errors[0], tmp_path, "holds a run already")
    second.close()


# --- Redis -----------------------------------------------------------------------------------------------------------


def test_a_run_whose_redis_is_killed_and_comes_back(tmp_path, redis, monkeypatch):
    """Everything is as if nothing had happened, and in between the status said what was wrong."""
    monkeypatch.setattr(run_writer, "STATUS_INTERVAL_S", 0.0)
    warned = []

    def each(metrics):
        warned.extend(status(tmp_path).warnings)
        if metrics["iteration"] == 2:
            redis.kill()
            time.sleep(0.7)  # longer than the writer sleeps between two tries
        if metrics["iteration"] == 6:
            redis.revive()

    config = tiny_config(total_env_steps=1500)
    done = run(tmp_path, config, on_iteration=each)
    assert done.reason == "finished"
    assert_one_line(warned[0], f"Redis at {redis.address} has taken nothing for")
    reader = RedisReader(redis.address)
    assert reader.metrics("cube") == read_lines(tmp_path / "runs" / "cube" / "metrics.jsonl")
    (told,) = reader.runs()
    assert told.model_dump(exclude={"heartbeat"}) == status(tmp_path).model_dump(exclude={"heartbeat"})
    assert (told.state, reader.goals("cube") is not None) == ("finished", True)
    play(tmp_path / "whole", config)
    assert_same_run(tmp_path / "runs" / "cube", tmp_path / "whole")


def test_a_status_service_without_the_shared_disk_serves_a_run_and_stops_it(tmp_path, redis):
    (tmp_path / "empty").mkdir()
    seen = {}

    def look(metrics):
        if metrics["iteration"] != 4:
            return
        with httpx.Client(base_url=server.url, headers=BEARER, **CLIENT) as client:
            # at iteration 4, what was told of iteration 3 is on its way to Redis
            wait_until(lambda: client.get("/v1/runs/cube").json().get("iteration", 0) >= 3)
            wait_until(lambda: client.get("/v1/runs/cube/metrics").json()["last_iteration"] >= 3)
            seen["runs"] = [each["run_id"] for each in client.get("/v1/runs").json()["runs"]]
            seen["grid"] = client.get("/v1/runs/cube/goals").json()["shape"]
            seen["gauge"] = 'tandem_run_iterations_total{run="cube"}' in client.get("/metrics").text
            assert client.post("/v1/runs/cube/stop").status_code == 202
        time.sleep(0.5)  # a message to Redis says that there is a request

    with StatusServer(open_reader(tmp_path / "empty"), Registry(tmp_path / "registry"), token=TOKEN, port=0) as server:
        done = run(tmp_path, tiny_config(total_env_steps=10**9), on_iteration=look)
        last = httpx.get(f"{server.url}/v1/runs/cube", headers=BEARER, **CLIENT).json()
    assert done.reason == "interrupted"
    assert (last["state"], last["epoch"], last["iteration"]) == ("interrupted", 1, done.iteration)
    assert seen == {"runs": ["cube"], "grid": [3, 3, 7], "gauge": True}
    assert list((tmp_path / "empty").iterdir()) == []


def test_a_redis_that_is_not_there_is_said_before_anything_is_learned(tmp_path, redis):
    redis.kill()
    with pytest.raises(StoreUnavailableError) as error:
        run(tmp_path)
    assert_one_line(error.value, f"Redis at {redis.address}", "TANDEM_REDIS_URL")
    redis.revive()
    assert run(tmp_path).reason == "finished"  # the directory is still free


def test_the_same_run_id_elsewhere(tmp_path, redis):
    other = a_writer(redis.address)
    wait_until(lambda: redis.address.client(1.0).exists("tandem:run:cube:heartbeat"))
    with pytest.raises(RunTakenError) as error:
        run(tmp_path)
    assert_one_line(error.value, "another run with the id cube reports to Redis")
    assert not (tmp_path / "runs" / "cube" / "config.yaml").exists()
    other.close()
    assert str(run(tmp_path).version) == "tiny@1"
    assert Registry(tmp_path / "registry").verify() == []
