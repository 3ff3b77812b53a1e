"""Studies: seeds, grids, cores, intervals, which run is the best, and real ones through kills, signals and resumes."""

import csv
import errno
import io
import json
import os
import re
import signal
import subprocess
import sys
import threading
from contextlib import nullcontext
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
from rich.console import Console

from service.actors.evaluation import EVALUATION_SEED, REPORTED_SEED, SELECTION_SEED, Evaluation
from service.base.errors import ConfigError, TandemError
from service.base.lock import is_locked
from service.base.progress import Display
from service.config import dump_config, load_config
from service.registry.loading import load
from service.registry.registry import Registry
from service.runs import study_results, study_run
from service.runs import train as training
from service.runs.grid import name_runs, parse_grid, parse_seeds
from service.runs.progress import Progress
from service.runs.resuming import resumed_config
from service.runs.signals import PARENT, InterruptError, StopSignals
from service.runs.study import Study
from service.runs.study_results import (
    as_csv,
    best_of,
    bootstrap_interval,
    interquartile_mean,
    published_metrics,
    select,
    summaries,
)
from service.runs.study_run import END_NOW, GO_ON, STOP, Job, Place, StudyRun, run_process, share
from service.runs.train import publish_learned
from service.store.checkpoints import CheckpointStore
from service.store.disk_reader import DiskReader
from service.store.run_directory import RunDirectory
from service.store.run_log import read_log
from service.store.run_writer import RunWriter
from tests.cli import typed
from tests.clock import Clock
from tests.runs.runs import (
    ROOT,
    TINY_TASK,
    assert_one_line,
    begin_study,
    newest,
    play,
    read_lines,
    tiny_config,
    write_yaml,
)
from tests.store.stores import a_status, wait_until

tandem = partial(typed.tandem, PYTHONPATH=str(ROOT), MUJOCO_GL="off")


# --- seeds and cores -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "seeds"),
    [("0,1,2", (0, 1, 2)), ("5", (5,)), ("0-4", (0, 1, 2, 3, 4)), ("7, 0-1", (7, 0, 1)), ("3-3", (3,))],
)
def test_seeds_are_numbers_and_ranges(text, seeds):
    assert parse_seeds(text) == seeds


@pytest.mark.parametrize(
    ("text", "part"),
    [
        ("0-3,2,1", "1, 2 given twice"),
        ("0,a", "'a'"),
        ("1.5", "'1.5'"),
        ("-1", "'-1'"),
        ("0,", "''"),
        ("4-0", "'4-0'"),
        ("0-999999999", "at most 1000"),
        ("0-998,1000-1001", "at most 1000"),
        ("\u0663", "\u0663"),  # a digit, in another script
    ],
)
def test_seeds_that_are_none_are_refused_with_one_line(text, part):
    with pytest.raises(ConfigError) as error:
        parse_seeds(text)
    assert_one_line(error.value, "--seeds", part)


def test_as_many_seeds_as_there_may_be():
    assert len(parse_seeds("0-998,1000")) == 1000


@pytest.mark.parametrize(
    ("texts", "grid"),
    [
        (["a.b=1e-4,3e-4"], {"a.b": ["1e-4", "3e-4"]}),
        (["a=1, 2", "b=x"], {"a": ["1", "2"], "b": ["x"]}),
        (["a=[1, 2],[[3],4]"], {"a": ["[1, 2]", "[[3],4]"]}),
        (["a='x,y',z"], {"a": ["'x,y'", "z"]}),
        (["primitives=panda-cube@6,runs/x"], {"primitives": ["panda-cube@6", "runs/x"]}),
        (["a={b: 1, c: 2},null"], {"a": ["{b: 1, c: 2}", "null"]}),
    ],
)
def test_a_grid_has_values_as_they_are_typed(texts, grid):
    assert parse_grid(texts) == grid


@pytest.mark.parametrize(
    ("texts", "seeds", "part"),
    [
        *(([text], None, "KEY=VALUE,VALUE") for text in ("a", "=1", "a=", "a=1,", "a=,1", "a=[1,2", "a=1],[2")),
        (["a=" + "[" * 5000], None, "KEY=VALUE,VALUE"),
        (["a=1,2,1"], None, "1 given twice"),
        (["a=1", "a=2"], None, "a is given by another --grid"),
        (["seed=1,2"], "0", "--seeds 0 and --grid seed"),
    ],
)
def test_a_grid_that_is_none_is_refused_with_one_line(texts, seeds, part):
    with pytest.raises(ConfigError) as error:
        parse_grid(texts, seeds)
    assert_one_line(error.value, part)


def test_names_of_runs_say_what_they_differ_in():
    grid = {"task": ["push"], "method": ["ours", "ours-her"], "learner.bob.learning_rate": ["1e-4"], "seed": ["0"]}
    names = ["push-ours-learning_rate-1e-4-seed-0", "push-ours-her-learning_rate-1e-4-seed-0"]
    assert list(name_runs(grid)) == names
    assert name_runs(grid)[names[1]] == {"task": "push", "method": "ours-her", "seed": "0"} | {
        "learner.bob.learning_rate": "1e-4"
    }
    assert list(name_runs({"seed": ["3", "8"]})) == ["seed-3", "seed-8"]
    assert list(name_runs({"a.x": ["1"], "b.x": ["../2"]})) == ["a.x-1-b.x-..-2"]
    for wrong, parts in (
        ({"a": ["x/y", "x y"]}, ["a-x-y", "name of two runs"]),
        ({"a": ["x" * 100]}, ["longer than 100 characters"]),
        ({"a": list(map(str, range(40))), "b": list(map(str, range(26)))}, ["1040 runs", "at most 1000"]),
    ):
        with pytest.raises(ConfigError) as error:
            name_runs(wrong)
        assert_one_line(error.value, *parts)


def test_cores_are_shared_out():
    play, task = tiny_config(num_threads=0), tiny_task(num_threads=0)
    for configs, place, parallel, found in (
        ([play] * 3, Place(2), None, (1, [2] * 3)),
        ([play] * 3, Place(1), None, (1, [1] * 3)),
        ([play] * 3, Place(8), None, (3, [2] * 3)),
        ([play] * 3, Place(16), None, (3, [5] * 3)),
        ([play] * 3, Place(2), 2, (2, [1] * 3)),
        ([play] * 3, Place(2), 9, (3, [1] * 3)),
        ([task] * 9, Place(4), None, (4, [1] * 9)),
        ([task] * 9, Place(4), 2, (2, [1] * 9)),
        ([play] * 2, Place(64, 16), None, (2, [16, 16])),  # no more than its machine has
        ([play], Place(64, 16), None, (1, [16])),
        ([tiny_config(num_threads=4), task], Place(8), None, (2, [4, 1])),
    ):
        assert share(configs, place, parallel) == found


def tiny_task(**run):
    return load_config(None, ["task=push", "method=ours", *(f"run.{key}={value}" for key, value in run.items())])


def test_more_cores_than_the_largest_machine_has_are_refused():
    config = tiny_config(num_threads=8)
    with pytest.raises(ConfigError, match=r"run.num_threads = 8, and the largest machine has 4 cores: give no more"):
        share([config], Place(8, 4), None)


def test_a_run_that_failed_beyond_its_result_has_none(tmp_path):
    play(tmp_path / "run")
    directory = RunDirectory(tmp_path / "run")
    status = a_status("run", state="failed", num_env_steps=200, last_error="it diverged")
    job = Job(tmp_path / "run", "", 400, StudyRun(settings={}))
    for env_steps, kept in ((100, {}), (200, {"mixed_success_last": 0.9})):
        directory.write_result({"evaluation": {"mixed_success_last": 0.9}, "env_steps": env_steps, "wall_s": 1.0})
        RunWriter(directory).status(status)
        assert (job.left().state, job.left().result) == ("failed", kept)


def test_what_a_run_is_told(tmp_path):
    """It begins with its file, and once it has begun, goes on with what the study changes in that."""
    config, path = tiny_config(seed=3, total_env_steps=999), tmp_path / "seed-3"
    job = Job(path, dump_config(config), 999, StudyRun(settings={"seed": "3"}), ("--registry", "r"))
    assert job.arguments() == [
        *("train", f"{path}.yaml", "--run-dir", str(path), "--resume=auto", "--no-publish", "--registry", "r"),
    ]
    assert load_config(tmp_path / "seed-3.yaml") == config
    bob = config.learner.bob.model_copy(update={"learning_rate": 1e-6})
    play(path, config.model_copy(update={"learner": config.learner.model_copy(update={"bob": bob})}), kill_after=1)
    assert resumed_config(RunDirectory(path), [], tmp_path / "seed-3.yaml") == config


# --- numbers ---------------------------------------------------------------------------------------------------------


def test_the_interquartile_mean_is_of_the_middle_half():
    assert interquartile_mean(np.array([9.0, 2.0, 0.0, 1.0])) == 1.5
    assert interquartile_mean(np.array([0.0, 1.0, 2.0, 3.0, 99.0])) == 2.0  # a quarter of 5, rounded down, is 1
    assert interquartile_mean(np.array([1.0, 2.0, 6.0])) == 3.0  # of three values, the mean of all
    rows = np.array([[4.0, 0.0, 1.0, 2.0, 3.0, 5.0, 6.0, 99.0], [1.0] * 8])
    assert interquartile_mean(rows).tolist() == [3.5, 1.0]


def test_bootstrap_intervals_by_hand():
    # Two values: their resampled mean is each of them with 1/4, and half the sum with 1/2.
    assert bootstrap_interval([[0.2, 0.6]]) == (0.2, 0.6)
    # Three: 1/27 = 3.7 % of the samples are the lowest alone, which is more than 2.5 %.
    assert bootstrap_interval([[0.0, 0.5, 1.0]]) == (0.0, 1.0)
    # Six values of which one is 1: it is in the middle half of six, the sorted places 2 to 5, as often as it is drawn
    # twice or more. Binomial(6, 1/6): P(>= 4) = .87 %, P(>= 3) = 6.2 %, so the upper end is that of 3: 2 of 4.
    low, high = bootstrap_interval([[0.0, 0.0, 0.0, 0.0, 0.0, 1.0]])
    assert (low, high) == (0.0, 0.5)
    # A task is resampled by itself: what differs between tasks adds nothing to the interval.
    assert bootstrap_interval([[0.0, 0.0], [1.0, 1.0]]) == (0.5, 0.5)
    assert bootstrap_interval([[0.7]]) == (0.7, 0.7)


def a_run(task, seed, success, **more):
    result = {"success_last": success, "success_ever": 1.0}
    return StudyRun(settings={"task": task, "seed": str(seed)}, state="finished", env_steps=9, result=result, **more)


def test_a_row_for_each_task_and_one_for_all():
    runs = [a_run("push", 0, 0.2), a_run("push", 1, 0.6), a_run("wall", 0, 1.0), a_run("wall", 1, 1.0)]
    rows = summaries([*runs, StudyRun(settings={"task": "wall", "seed": "2"}, state="failed")])
    assert [(settings, row.num) for settings, row in rows] == [
        ({"task": "push"}, 2),
        ({"task": "wall"}, 2),
        ({"task": "all"}, 4),
    ]
    push, wall, both = (row for _, row in rows)
    assert (push.mean, push.iqm, push.low, push.high) == pytest.approx((0.4, 0.4, 0.2, 0.6))
    assert (wall.mean, wall.iqm, wall.low, wall.high) == (1.0, 1.0, 1.0, 1.0)
    assert (both.mean, both.iqm) == pytest.approx((0.7, 0.8))  # of .2 .6 1 1 the middle two
    assert (both.low, both.high) == pytest.approx((0.6, 0.8))  # .2 .2 | 1 1 has .6, .6 .6 | 1 1 has .8


def test_a_line_for_each_run():
    runs = {"a": a_run("push", 0, 0.25, wall_s=1.25), "b": StudyRun(settings={"task": "push", "seed": "1"})}
    assert as_csv(runs) == (
        "run,task,seed,state,env_steps,wall_s,success_last,success_ever\n"
        "a,push,0,finished,9,1.2,0.25,1.0\n"
        "b,push,1,waiting,0,0.0,,\n"
    )


# --- the best one ----------------------------------------------------------------------------------------------------


def an_evaluation(success_last, distance_m=0.1, goals="mixed"):
    return Evaluation(goals, 1000, 50, success_last, success_last - 0.02, success_last + 0.02, 1.0, distance_m)


def test_the_best_is_chosen_by_the_selections_goals_alone():
    def run(success, distance_m, reported, state="finished"):
        result = {"selection_success_last": success, "selection_mean_distance_m": distance_m}
        return StudyRun(settings={}, state=state, result=result | {"mixed_success_last": reported})

    runs = {"0": run(0.90, 0.1, 0.99), "1": run(0.95, 0.03, 0.10), "2": run(0.95, 0.02, 0.10)}
    assert best_of(runs) == "2"  # of equals, the one that ends nearer
    assert best_of(runs | {"3": run(0.99, 0.0, 0.5, "failed"), "4": a_run("push", 0, 1.0)}) == "2"
    assert best_of({"4": a_run("push", 0, 1.0)}) is None


@pytest.mark.parametrize(("fixture", "goals"), [("none", "mixed"), ("wall", "table")])
def test_goals_that_choose_are_not_those_that_are_reported(monkeypatch, tmp_path, fixture, goals):
    asked = []

    def evaluate(policy, world, kind, *, num_episodes, num_steps, success_distance_m, seed, num_threads):
        asked.append((kind, num_episodes, num_steps, seed))
        return an_evaluation(0.5, goals=kind)

    config = tiny_config(total_env_steps=120)
    play(tmp_path, config.model_copy(update={"world": config.world.model_copy(update={"fixture": fixture})}))
    monkeypatch.setattr("service.actors.evaluation.evaluate", evaluate)
    assert select(tmp_path) == {"selection_success_last": 0.5, "selection_mean_distance_m": 0.1}
    assert asked == [(goals, 1000, 2, SELECTION_SEED)]
    # recorded figures are of these goals, and what chose is not what is reported
    assert (EVALUATION_SEED, REPORTED_SEED, SELECTION_SEED) == (1_000_003, 1_000_004, 1_000_005)


def test_a_better_run_found_by_a_resume_becomes_the_next_version(tmp_path):
    registry, study = Registry(tmp_path / "registry"), begin_study(tmp_path / "study")
    result = {"mixed_success_last": 0.5, "selection_success_last": 0.75, "selection_mean_distance_m": 0.1}
    run = StudyRun(settings={}, state="finished", env_steps=120, result=result)
    published, metrics = [], published_metrics(run, "mixed")
    for seed in (0, 1):
        directory = study.path / f"seed-{seed}"
        play(directory, tiny_config(seed=seed, total_env_steps=120))
        published += [
            publish_learned(directory, registry.root, metrics=metrics) for _ in range(2)
        ]  # again: it is there
    assert [str(version) for version in published] == ["tiny@1", "tiny@1", "tiny@2", "tiny@2"]
    manifest = registry.manifest("tiny@latest")
    assert (manifest.version, manifest.config["seed"], manifest.parent) == (2, 1, None)
    assert manifest.metrics == {
        "selection/mixed_success_last": 0.75,
        "evaluation/mixed_success_last": 0.5,
        "env_steps": 120,
    }


# --- side by side ----------------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("default_signals")
@pytest.mark.parametrize("num_signals", [0, 1, 2])
def test_runs_begin_in_turn_and_are_asked_to_stop_and_then_to_end(tmp_path, num_signals):
    study, told = begin_study(tmp_path / "study"), {}
    configs = {name: load_config(study.config_file(name)) for name in ("seed-0", "seed-1")}

    def run(job, asked):
        wait_until(lambda: Study(study.path).read().runs[job.directory.name].state == "running")
        for wanted in range(1, num_signals + 1):
            os.kill(os.getpid(), signal.SIGINT)
            wait_until(lambda wanted=wanted: asked() == wanted)
        told[job.directory.name] = (asked(), job.options)
        return job.run.now("failed", "no luck") if num_signals == 0 else job.run.now("interrupted")

    progress = Progress(Display(Console(file=io.StringIO())))
    with StopSignals() as signals, pytest.raises(InterruptError) if num_signals == 2 else nullcontext():
        study.train(configs, Place(1, run=run), None, ["--registry", "r"], signals, progress)
    states = [(each.state, each.error) for each in study.read().runs.values()]
    if num_signals == 0:
        assert states == [("failed", "no luck")] * 2
    else:
        assert states == [("interrupted", None), ("waiting", None)]
    options = ("--registry", "r", "--set", "run.num_threads=1")  # which the configuration says
    assert told == dict.fromkeys(configs if num_signals == 0 else ["seed-0"], (num_signals, options))


@pytest.mark.parametrize(
    ("script", "asked", "state", "error"),
    [
        ("echo 'error: no luck'; exit 3", GO_ON, "failed", "no luck; all it said is in"),
        ("exit 0", GO_ON, "waiting", None),
        ("trap 'exit 138' USR1; echo ready; while :; do sleep 0.05; done", STOP, "waiting", None),
        ("trap '' USR1 TERM; echo ready; while :; do sleep 0.05; done", END_NOW, "failed", "ended by SIGKILL"),
    ],
)
def test_how_the_process_of_a_run_ends(tmp_path, monkeypatch, script, asked, state, error):
    """A shell script in place of a run, which is told to stop or to end once it is ready."""
    program, job = tmp_path / "python", Job(tmp_path / "run", dump_config(tiny_config()), 600, StudyRun(settings={}))
    program.write_text(f"#!/bin/sh\n{script}\n")
    program.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(program))
    monkeypatch.setattr(study_run, "PATIENCE_S", (0.1, 0.1, 60.0))
    log = job.directory / "log.txt"
    found = run_process(job, lambda: asked if log.exists() and "ready" in log.read_text() else GO_ON)
    assert (found.state, found.error is None) == (state, error is None)
    assert error is None or error in found.error


def test_a_machine_that_has_no_process_for_a_run_fails_that_run_alone(tmp_path, monkeypatch):
    def refuse(*_, **__):
        raise BlockingIOError(errno.EAGAIN, os.strerror(errno.EAGAIN))

    monkeypatch.setattr(subprocess, "Popen", refuse)
    job = Job(tmp_path / "run", dump_config(tiny_config()), 600, StudyRun(settings={}))
    found = run_process(job, lambda: GO_ON)
    assert (found.state, os.strerror(errno.EAGAIN) in found.error) == ("failed", True)


def test_a_run_waits_until_the_server_gives_up_the_lock_of_a_lost_machine(tmp_path, monkeypatch):
    clock, begun_s = Clock(), []
    freed_s = clock.now_s + 95.0  # a lease of NFSv4 has 90 s

    def sleep(seconds):
        clock.now_s += seconds

    def begin(*_, **__):
        begun_s.append(clock.now_s)
        raise BlockingIOError(errno.EAGAIN, os.strerror(errno.EAGAIN))

    monkeypatch.setattr(study_run, "time", SimpleNamespace(monotonic=clock, sleep=sleep))
    monkeypatch.setattr(study_run, "is_locked", lambda _: clock.now_s < freed_s)
    monkeypatch.setattr(subprocess, "Popen", begin)
    run_process(Job(tmp_path / "run", dump_config(tiny_config()), 600, StudyRun(settings={})), lambda: GO_ON)
    assert begun_s == [pytest.approx(freed_s, abs=1.0)]


# --- a whole one -----------------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("default_signals", "no_artifacts")
def test_a_study_is_killed_stopped_resumed_and_names_its_best(tmp_path, monkeypatch):
    monkeypatch.setattr(study_results, "SELECTION_EPISODES", 20)
    path, registry = tmp_path / "study", tmp_path / "registry"
    study, common = Study(path), ("pretrain", "--run-dir", path, "--registry", registry)
    places = {seed: RunDirectory(path / f"seed-{seed}") for seed in (3, 8)}
    config = write_yaml(tmp_path / "tiny.yaml")

    def told():
        return {name: run.state for name, run in study.read().runs.items()}

    def saved(seed):
        return len(list(places[seed].checkpoints.glob("checkpoint-*"))) >= 2

    def trouble():
        """One run is killed, and the other goes on; then all are stopped."""
        try:
            wait_until(lambda: saved(3) and saved(8))
            os.kill(json.loads((path / "seed-8" / ".lock").read_text())["pid"], signal.SIGKILL)
            wait_until(lambda: told()["seed-8"] == "failed")
            before = newest(path / "seed-3").step
            wait_until(lambda: newest(path / "seed-3").step > before)
        finally:
            os.kill(os.getpid(), signal.SIGINT)

    troublemaker = threading.Thread(target=trouble)
    troublemaker.start()
    endless = ("--set", "run.total_env_steps=1_000_000_000")
    result = tandem(*common, "--config", config, "--seeds", "3,8", "--parallel", 2, *endless)
    troublemaker.join()

    assert result.exit_code == 130, result.output
    how = f"tandem train --resume --run-dir {path} --registry {registry} --parallel 2"
    assert f"saved; continue with: {how}\n" in result.stdout
    assert_one_line(result.stderr.splitlines()[-1], "seed-8 failed: ended by SIGKILL", path / "seed-8" / "log.txt")
    assert re.search(r"^seed-[38]: [0-9,]+ of [0-9,]+ env steps, .* \| ", result.stderr, re.MULTILINE)
    assert told() == {"seed-3": "interrupted", "seed-8": "failed"}
    statuses = {run.run_id: run for run in DiskReader(tmp_path).runs()}  # as the status service lists them
    assert set(statuses) == {"study-seed-3", "study-seed-8"}
    assert newest(path / "seed-3").step == statuses["study-seed-3"].iteration  # nothing was lost
    assert not registry.exists()

    steps = max(newest(path / f"seed-{seed}").meta["env_steps"] for seed in (3, 8)) + 1
    for place in places.values():  # in this process, which is quicker; the study finds them as they were left
        longer = resumed_config(place, [f"run.total_env_steps={steps}"])
        training.train(longer, place, registry, resume=True, publish=False, on_iteration=lambda metrics: None)
    result = tandem(*common, "--resume", "--set", f"run.total_env_steps={steps}")
    assert result.exit_code == 0, result.output
    found = study.read()
    assert told() == {"seed-3": "finished", "seed-8": "finished"}
    for name, run in found.runs.items():
        rows = read_lines(path / name / "metrics.jsonl")
        assert [row["iteration"] for row in rows] == list(range(1, len(rows) + 1))
        assert run.env_steps == rows[-1]["env_steps"] >= steps
        assert f"seed-{RunDirectory(path / name).read_config().seed}" == name
        assert (
            run.result["mixed_success_last"]
            == RunDirectory(path / name).read_result()["evaluation"]["mixed_success_last"]
        )
        assert 0.0 <= run.result["selection_success_last"] <= 1.0
    assert f"best         {found.best}, " in result.stdout
    assert (path / "curves.png").read_bytes()[:4] == b"\x89PNG"

    versions = Registry(registry).versions("tiny")  # of the best alone
    assert [str(version) for version in versions] == ["tiny@1"] == [found.published]
    manifest, parameters = Registry(registry).load("tiny@latest")
    assert f"seed-{manifest.config['seed']}" == found.best
    assert manifest.metrics["env_steps"] == found.runs[found.best].env_steps
    bob = load(str(path / found.best)).parameters
    assert all(np.array_equal(parameters[name], array) for name, array in bob.items())
    assert DiskReader(path).run(f"study-{found.best}").published == "tiny@1"

    logs = [(place.path / "log.txt").read_bytes() for place in places.values()]
    again = tandem(*common, "--seeds", "8,3", "--resume", "--config", config)  # nothing is left to do
    assert again.exit_code == 0, again.output
    assert [(place.path / "log.txt").read_bytes() for place in places.values()] == logs
    assert len(Registry(registry).versions("tiny")) == 1


def test_two_tasks_are_killed_with_their_study_and_go_on(tmp_path):
    """The study's process and that of a run are killed at once, and the other run has not begun."""
    study = Study(tmp_path / "night")
    given = [*TINY_TASK, "push,wall", "--seeds", "0", "--run-dir", str(study.path), "--parallel", "1"]
    command = [sys.executable, "-m", "service", "train", *given, "--set", "run.total_env_steps=1_000_000"]
    begun = study.path / "push-seed-0"

    def saved():
        return any(step >= 2 for step in CheckpointStore(begun / "checkpoints", keep=1).steps())

    with subprocess.Popen(command, cwd=ROOT, stderr=subprocess.PIPE, text=True) as process:
        try:
            wait_until(lambda: process.poll() is not None or saved())
            assert process.poll() is None, process.stderr.read()
        finally:
            process.kill()  # at once with the run, which the kernel would tell to save
        os.kill(json.loads((begun / ".lock").read_text())["pid"], signal.SIGKILL)
        wait_until(lambda: not is_locked(begun))
    states = {name: run.state for name, run in study.read().runs.items()}
    assert states == {"push-seed-0": "running", "wall-seed-0": "waiting"}
    assert {run.study for run in DiskReader(tmp_path).runs()} == {"night"}  # the page shows them as one

    steps = newest(begun).meta["env_steps"] + 200
    result = tandem("train", "--resume", "--run-dir", study.path, "--set", f"run.total_env_steps={steps}")
    assert result.exit_code == 0, result.output
    found = study.read()
    assert (found.best, found.published, list(found.runs)) == (None, None, list(states))
    for name, run in found.runs.items():
        rows = read_lines(study.path / name / "metrics.jsonl")
        assert [row["iteration"] for row in rows] == list(range(1, len(rows) + 1))
        assert (run.state, run.env_steps, rows[-1]["env_steps"]) == ("finished", steps, steps)
        config = RunDirectory(study.path / name).read_config()
        assert (config.task, str(config.seed)) == (run.settings["task"], run.settings["seed"])
        assert run.result == RunDirectory(study.path / name).read_result()["evaluation"]
        goes_on = any("goes on with the run" in entry.text for entry in read_log(study.path / name))
        assert goes_on == (name == begun.name)
    with (study.path / "results.csv").open() as file:
        lines = list(csv.DictReader(file))
    assert [(line["task"], line["seed"], line["success_last"]) for line in lines] == [
        (run.settings["task"], run.settings["seed"], str(run.result["success_last"])) for run in found.runs.values()
    ]
    assert re.search(r"^push\t1\t.*^wall\t1\t.*^all\t2\t", result.stdout, re.MULTILINE | re.DOTALL)
    assert (study.path / "curves.png").read_bytes()[:4] == b"\x89PNG"

    logs = {path: path.read_bytes() for path in study.path.glob("*/log.txt")}
    again = tandem("train", "push,wall", "--seeds", "0", "--run-dir", study.path, "--resume")
    assert again.exit_code == 0, again.output
    assert {path: path.read_bytes() for path in logs} == logs  # finished runs are left alone


def test_a_run_is_told_when_the_process_of_the_study_is_gone(tmp_path):
    """The study's process is the middle one: it is killed while the run, below it, waits (or is still printing)."""
    run = (
        "import os, signal, time; from service.runs.signals import stop_with_parent\n"
        "signal.signal(signal.SIGUSR1, lambda *_: (os.write(1, b'told\\n'), os._exit(0)))\n"
        "stop_with_parent(); print('ready', flush=True); time.sleep(60)"
    )
    middle = (
        "import os, subprocess, sys, time\n"
        f"subprocess.Popen([sys.executable, '-c', {run!r}], env=dict(os.environ, {PARENT}=str(os.getpid())),"
        " start_new_session=True); time.sleep(60)"
    )
    with subprocess.Popen([sys.executable, "-c", middle], cwd=ROOT, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout.readline() == "ready\n"
        process.kill()
        assert process.stdout.read() == "told\n"


# --- what a mistake gets ---------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def begun(tmp_path_factory):
    """A study that has begun, with one of its two runs."""
    study = begin_study(tmp_path_factory.mktemp("begun") / "study")
    play(study.path / "seed-0", tiny_config(total_env_steps=120))
    return study


NOWHERE = ("--run-dir", "NOWHERE")


@pytest.mark.parametrize(
    ("arguments", "parts"),
    [
        (["--seeds", "0,1"], ["holds a study already", "--resume"]),
        ([], ["holds a study already", "--resume"]),
        (["--seeds", "0,1", "--set", "seed=3"], ["--set seed=3", "leave it out"]),
        (["--resume", "--seeds", "0-2"], ["has the runs seed-0, seed-1, not seed-0, seed-1, seed-2"]),
        (["--resume", "--set", "game.num_worlds=3"], ["game.num_worlds = 3", "keeps its configuration"]),
        (["--resume", "--config", "OTHER"], ["game.num_goals", "keeps its configuration"]),
        (["--seeds", "0", "--run-dir", "RUN"], ["seed-0 holds a run already", "another --run-dir"]),
        (["--seeds", "0", "--run-dir", "PARENT"], ["seed-0 holds a run already", "another --run-dir"]),
        (["--resume", "--seeds", "0", *NOWHERE], ["no study in", "study.json", "--resume"]),
        (["--parallel", "2", *NOWHERE], ["--parallel", "--seeds"]),
        (["--seeds", "0", "--grid", "game.num_goals=1,x", *NOWHERE], ["game.num_goals", "'x'"]),
        (["--seeds", "0", "--grid", "game.nums=1", *NOWHERE], ["game.nums", "unknown key"]),
        (["push,wal", *NOWHERE], ["'wal'", "did you mean 'wall'"]),
        (["push,push", *NOWHERE], ["push given twice"]),
        (["push,panda-cube", *NOWHERE, "--primitives", "x"], ["--primitives", "task"]),
        (["push", "--method", "ours,lsd", *NOWHERE], ["panda-cube@", "skills"]),
        (["push", "--grid", "task=wall", *NOWHERE], ["push", "--grid task=wall", "one of them"]),
        (["push,wall", "--publish", *NOWHERE], ["--publish", "--resume --publish --run-dir"]),
        (["--seeds", "0", "--registry", "http://x:1", *NOWHERE], ["http://x:1", "read only"]),
        (["--seeds", "0", "--runtime", "ray", "--num-actors", "2"], ["--num-actors", "run.num_threads=N"]),
    ],
)
def test_mistakes_get_one_line_and_lose_nothing(begun, tmp_path, arguments, parts):
    study = begun
    before = {path: path.read_bytes() for path in study.path.rglob("*") if path.is_file()}
    parent = tmp_path / "parent"  # runs without a study around them
    (parent / "seed-0").mkdir(parents=True)
    (parent / "seed-0" / "config.yaml").write_bytes((study.path / "seed-0" / "config.yaml").read_bytes())
    other = tiny_config().model_dump(mode="json")
    other["game"]["num_goals"] += 1
    names = {
        "OTHER": write_yaml(tmp_path / "other.yaml", other),
        "RUN": study.path / "seed-0",
        "PARENT": parent,
        "NOWHERE": tmp_path / "nowhere",
    }
    where = [] if "--run-dir" in arguments else ["--run-dir", study.path]
    result = tandem("pretrain", *where, *(names.get(each, each) for each in arguments))
    typed.assert_refused(result, *parts)
    assert {path: path.read_bytes() for path in study.path.rglob("*") if path.is_file()} == before
    assert not (tmp_path / "nowhere").exists()


def test_a_study_whose_file_cannot_be_read(tmp_path):
    study = begin_study(tmp_path)
    for text in ("no json", "{}", '{"runs": {"a": 1}}', "[]", "[" * 10_000):
        study.file.write_text(text)
        with pytest.raises(TandemError) as error:
            study.read()
        assert_one_line(error.value, study.file, "does not name the runs")
