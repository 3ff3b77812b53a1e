"""Studies: seeds, cores, which run is the best, and a real one through a kill, a signal and a resume."""

import json
import os
import re
import signal
import subprocess
import sys
import threading
import time

import numpy as np
import pytest
from typer.testing import CliRunner

from service.actors.evaluation import EVALUATION_SEED, REPORTED_SEED, SELECTION_SEED, Evaluation
from service.cli.main import app
from service.errors import ConfigError, TandemError
from service.io.study_directory import StudyDirectory
from service.primitives.loading import load
from service.registry.registry import Registry
from service.runs.resuming import resumed_config
from service.runtime import study_results
from service.runtime.pretrain_study import StudyCluster, _arguments, _share
from service.runtime.ray_connection import ClusterOptions
from service.runtime.study import RunEnd, Study
from service.runtime.study_plan import Share, check_same_seeds, parse_seeds, share_cluster, share_machine
from service.runtime.study_results import Scores, best_seed, publish_best, score
from service.store.disk_reader import DiskReader
from tests.runtime.runs import ROOT, assert_one_line, newest, play, read_lines, tiny_config, write_yaml

PATIENCE_S = 300.0


def tandem(*arguments, **environment):
    """Run a command in this process."""
    variables = {"COLUMNS": "80", "PYTHONPATH": str(ROOT), "MUJOCO_GL": "off", **environment}
    return CliRunner().invoke(app, [str(argument) for argument in arguments], env=variables)


def wait_for(what):
    deadline_s = time.monotonic() + PATIENCE_S
    while not what():
        assert time.monotonic() < deadline_s, "not within 300 s"
        time.sleep(0.02)


# --- seeds and cores -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "seeds"),
    [("0,1,2", (0, 1, 2)), ("5", (5,)), ("0-4", (0, 1, 2, 3, 4)), ("7, 0-1", (7, 0, 1)), ("3-3", (3,))],
)
def test_seeds_are_numbers_and_ranges(text, seeds):
    assert parse_seeds(text) == seeds


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("0,0", ["seed 0 given twice", "name it once"]),
        ("0-3,2,1", ["seeds 1, 2 given twice"]),
        ("0,a", ["'a'", "0,1,2 or 0-4"]),
        ("1.5", ["'1.5'"]),
        ("-1", ["'-1'"]),
        ("", ["''"]),
        ("0,", ["''"]),
        ("4-0", ["4-0", "goes down", "0-4"]),
        ("0-999999999", ["more than 1000"]),
        ("0-998,1000-1001", ["more than 1000"]),
        ("\u0663", ["\u0663"]),  # a digit, in another script
    ],
)
def test_seeds_that_are_none_are_refused_with_one_line(text, parts):
    with pytest.raises(ConfigError) as error:
        parse_seeds(text)
    assert_one_line(error.value, "--seeds", *parts)


def test_as_many_seeds_as_there_may_be():
    assert len(parse_seeds("0-998,1000")) == 1000


def test_a_resumed_study_keeps_its_seeds_in_whatever_order():
    check_same_seeds((2, 0, 1), (0, 1, 2))
    with pytest.raises(ConfigError) as error:
        check_same_seeds((0, 1), (0, 1, 2))
    assert_one_line(error.value, "seeds 0, 1, 2", "seeds 0, 1", "leave out --seeds")


@pytest.mark.parametrize(
    ("num_cores", "num_runs", "parallel", "share"),
    [
        (2, 3, None, Share(1, 2)),
        (1, 3, None, Share(1, 1)),
        (8, 3, None, Share(3, 2)),
        (16, 3, None, Share(3, 5)),
        (16, 20, None, Share(8, 2)),
        (2, 3, 2, Share(2, 1)),
        (2, 3, 9, Share(3, 1)),
    ],
)
def test_a_machine_is_shared_out(num_cores, num_runs, parallel, share):
    assert share_machine(num_cores, num_runs, parallel) == share


@pytest.mark.parametrize(
    ("num_cores", "num_runs", "options", "share"),
    [
        (64.0, 4, {}, Share(4, 16)),
        (63.0, 4, {}, Share(4, 15)),
        (3.0, 5, {}, Share(3, 1)),
        (0.0, 5, {}, Share(1, 1)),  # a cluster that grows when it is asked to
        (64.0, 4, {"learner_cpus": 1.0}, Share(4, 15)),
        (3.0, 5, {"learner_cpus": 1.0}, Share(1, 2)),
        (64.0, 4, {"num_actors": 30}, Share(2, 30)),
        (64.0, 4, {"parallel": 2}, Share(2, 32)),
        (64.0, 4, {"actor_threads": 8, "learner_cpus": 1.0}, Share(4, 1)),
        (64.0, 4, {"actor_threads": 8, "num_actors": 3}, Share(2, 3)),
    ],
)
def test_a_cluster_is_shared_out(num_cores, num_runs, options, share):
    assert share_cluster(num_cores, num_runs, **options) == share


def test_what_a_run_on_a_cluster_is_told(tmp_path):
    cluster = StudyCluster("10.0.0.1:6379", 9.0, ClusterOptions(learner_cpus=0.5))
    num_parallel, place = _share(tiny_config(), 2, None, cluster)
    assert num_parallel == 2
    arguments = _arguments(tiny_config(), StudyDirectory(tmp_path), 7, place)
    assert " ".join(arguments) == (
        f"pretrain --run-dir {tmp_path}/seed-7 --no-publish --config {tmp_path}/study.yaml --set seed=7 "
        "--runtime ray --address 10.0.0.1:6379 --status off --num-actors 4 --actor-threads 1 --learner-cpus 0.5"
    )


def test_a_study_remembers_what_its_runs_begin_from(tmp_path):
    directory = StudyDirectory(tmp_path)
    directory.begin(tiny_config(), [3], "panda-cube@6")
    start = directory.read_start()
    assert start == "panda-cube@6"
    Study(directory, [3], 600, start).save()
    assert directory.read_start() == start
    directory.close()
    assert " ".join(_arguments(tiny_config(), directory, 3, ["--place"], ["--from", start])).endswith(
        "--set seed=3 --from panda-cube@6 --place"
    )
    directory.run(3).path.mkdir()
    directory.run(3).config_file.write_text("")
    assert "--from" not in _arguments(tiny_config(), directory, 3, [], ["--from", start])


def test_a_run_that_has_begun_is_resumed_with_the_budget_of_the_study(tmp_path):
    run = StudyDirectory(tmp_path).run(3)
    play(run.path, tiny_config(seed=3, total_env_steps=120))
    config = tiny_config(total_env_steps=999)
    arguments = _arguments(config, StudyDirectory(tmp_path), 3, ["--set", "run.num_threads=2"])
    assert arguments[:4] == ["pretrain", "--run-dir", str(run.path), "--no-publish"]
    assert "--resume" in arguments
    overrides = [arguments[place + 1] for place, each in enumerate(arguments) if each == "--set"]
    assert resumed_config(run, overrides) == tiny_config(seed=3, total_env_steps=999, num_threads=2)


# --- the best one ----------------------------------------------------------------------------------------------------


def an_evaluation(success_last, distance_m=0.1, goals="mixed"):
    return Evaluation(goals, 1000, 50, success_last, success_last - 0.02, success_last + 0.02, 1.0, distance_m)


def test_the_best_is_chosen_by_the_selections_goals_alone():
    scores = {
        0: Scores(an_evaluation(0.90), (an_evaluation(0.99),)),
        1: Scores(an_evaluation(0.95, 0.03), (an_evaluation(0.10),)),
        2: Scores(an_evaluation(0.95, 0.02), (an_evaluation(0.10),)),
    }
    assert best_seed(scores) == 2  # of equals, the one that ends nearer


def test_goals_that_choose_are_not_those_that_are_reported(monkeypatch, tmp_path):
    asked = []

    def evaluate(policy, world, kind, *, num_episodes, num_steps, success_distance_m, seed, num_threads):
        asked.append((kind, num_episodes, num_steps, seed))
        return an_evaluation(0.5, goals=kind)

    play(tmp_path, tiny_config(total_env_steps=120))
    monkeypatch.setattr("service.actors.evaluation.evaluate", evaluate)
    scores = score(tiny_config(), load(str(tmp_path)).parameters)
    reported = [(kind, 1000, 2, REPORTED_SEED) for kind in ("table", "air", "mixed")]
    assert sorted(asked) == sorted([*reported, ("mixed", 1000, 2, SELECTION_SEED)])
    # recorded figures are of these goals, and what chose is not what is reported
    assert (EVALUATION_SEED, REPORTED_SEED, SELECTION_SEED) == (1_000_003, 1_000_004, 1_000_005)
    assert scores.selection.goals == "mixed"
    assert [each.goals for each in scores.reported] == ["table", "air", "mixed"]
    assert set(scores.metrics()) == {
        f"{name}_success_{which}"
        for name in ("evaluation/table", "evaluation/air", "evaluation/mixed", "selection/mixed")
        for which in ("last", "ever")
    }


def test_a_better_run_found_by_a_resume_becomes_the_next_version(tmp_path):
    registry, study = Registry(tmp_path / "registry"), StudyDirectory(tmp_path / "study")
    study.begin(tiny_config(), (0, 1))
    scores = Scores(an_evaluation(0.75), (an_evaluation(0.5),))
    published = []
    for seed in (0, 1):
        directory = study.run(seed)
        play(directory.path, tiny_config(seed=seed, total_env_steps=120))
        # the second time it is there already
        published += [publish_best(study, registry, RunEnd(seed, "finished", 120), scores) for _ in range(2)]
    study.close()
    assert [str(version) for version in published] == ["tiny@1", "tiny@1", "tiny@2", "tiny@2"]
    manifest = registry.manifest("tiny@latest")
    assert (manifest.version, manifest.config["seed"], manifest.parent) == (2, 1, None)
    assert manifest.metrics["selection/mixed_success_last"] == 0.75
    assert manifest.metrics["evaluation/mixed_success_last"] == 0.5
    assert manifest.metrics["env_steps"] == 120


# --- a whole one -----------------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("default_signals")
def test_a_study_is_killed_stopped_resumed_and_names_its_best(tmp_path, monkeypatch):
    monkeypatch.setattr(study_results, "NUM_EPISODES", 20)
    path, registry = tmp_path / "study", tmp_path / "registry"
    study, common = StudyDirectory(path), ("pretrain", "--run-dir", path, "--registry", registry)
    config = write_yaml(tmp_path / "tiny.yaml")

    def told():
        return json.loads(study.results_file.read_text())["runs"]

    def saved(seed):
        return len(list(study.run(seed).checkpoints.glob("checkpoint-*"))) >= 2

    def trouble():
        """One run is killed, and the other goes on; then all are stopped."""
        try:
            wait_for(lambda: saved(3) and saved(8))
            os.kill(json.loads((study.run(8).path / ".lock").read_text())["pid"], signal.SIGKILL)
            wait_for(lambda: told()["8"]["state"] == "failed")
            before = newest(study.run(3).path).step
            wait_for(lambda: newest(study.run(3).path).step > before)
        finally:
            os.kill(os.getpid(), signal.SIGINT)

    troublemaker = threading.Thread(target=trouble)
    troublemaker.start()
    endless = ("--set", "run.total_env_steps=1_000_000_000")
    result = tandem(*common, "--config", config, "--seeds", "3,8", "--parallel", 2, *endless)
    troublemaker.join()

    assert result.exit_code == 130, result.output
    assert f"saved; continue with: tandem pretrain --resume --run-dir {path} --registry {registry}\n" in result.stdout
    assert_one_line(result.stderr.splitlines()[-1], "seed 8 failed: ended by SIGKILL", path / "seed-8" / "log.txt")
    assert re.search(r"^seed [38]: [0-9,]+ of [0-9,]+ env steps, .* \| ", result.stderr, re.MULTILINE)
    assert {seed: run["state"] for seed, run in told().items()} == {"3": "interrupted", "8": "failed"}
    statuses = {run.run_id: run for run in DiskReader(tmp_path).runs()}  # as the status service lists them
    assert set(statuses) == {"study-seed-3", "study-seed-8"}
    assert newest(path / "seed-3").step == statuses["study-seed-3"].iteration  # nothing was lost
    assert not registry.exists()

    steps = max(newest(path / f"seed-{seed}").meta["env_steps"] for seed in (3, 8)) + 1
    result = tandem(*common, "--resume", "--set", f"run.total_env_steps={steps}")
    assert result.exit_code == 0, result.output
    results = json.loads(study.results_file.read_text())
    assert results["seeds"] == [3, 8]
    assert {run["state"] for run in results["runs"].values()} == {"finished"}
    for seed in (3, 8):
        rows = read_lines(path / f"seed-{seed}" / "metrics.jsonl")
        assert [row["iteration"] for row in rows] == list(range(1, len(rows) + 1))
        assert results["runs"][str(seed)]["env_steps"] == rows[-1]["env_steps"] >= steps
        assert study.run(seed).read_config().seed == seed
        assert results["scores"][str(seed)]["selection"]["num_episodes"] == 20
    best = results["best"]["seed"]
    assert f"best         seed {best}" in result.stdout
    assert (path / "curves.png").read_bytes()[:4] == b"\x89PNG"

    versions = Registry(registry).versions("tiny")  # of the best alone
    assert [str(version) for version in versions] == ["tiny@1"] == [results["best"]["published"]]
    manifest, parameters = Registry(registry).load("tiny@latest")
    assert manifest.config["seed"] == best
    assert manifest.metrics["env_steps"] == results["runs"][str(best)]["env_steps"]
    bob = load(str(study.run(best).path)).parameters
    assert all(np.array_equal(parameters[name], array) for name, array in bob.items())
    assert DiskReader(path).run(f"study-seed-{best}").published == "tiny@1"

    logs = [study.log_file(seed).read_bytes() for seed in (3, 8)]
    again = tandem(*common, "--seeds", "8,3", "--resume", "--config", config)  # nothing is left to do
    assert again.exit_code == 0, again.output
    assert [study.log_file(seed).read_bytes() for seed in (3, 8)] == logs
    assert len(Registry(registry).versions("tiny")) == 1


def test_a_run_is_told_when_the_process_of_the_study_is_gone(tmp_path):
    """The study's process is the middle one: it is killed while the run, below it, waits."""
    run = (
        "import os, signal, sys, time; from service.cli.study_run import stop_with\n"
        "signal.signal(signal.SIGUSR1, lambda *_: (print('told', flush=True), os._exit(0)))\n"
        "stop_with(int(sys.argv[1])); print('ready', flush=True); time.sleep(60)"
    )
    middle = (
        "import os, subprocess, sys, time\n"
        f"subprocess.Popen([sys.executable, '-c', {run!r}, str(os.getpid())], start_new_session=True); time.sleep(60)"
    )
    with subprocess.Popen([sys.executable, "-c", middle], cwd=ROOT, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout.readline() == "ready\n"
        process.kill()
        assert process.stdout.read() == "told\n"


# --- what a mistake gets ---------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def begun(tmp_path_factory):
    """A study that has begun, with one of its two runs, and its configuration file."""
    home = tmp_path_factory.mktemp("begun")
    study = StudyDirectory(home / "study")
    study.begin(tiny_config(), (0, 1))
    study.close()
    play(study.run(0).path, tiny_config(total_env_steps=120))
    return study, write_yaml(home / "tiny.yaml")


@pytest.mark.parametrize(
    ("arguments", "parts"),
    [
        (["--seeds", "0,0"], ["seed 0 given twice"]),
        (["--seeds", "0,1"], ["holds a study already", "--resume"]),
        ([], ["holds a study already", "--resume"]),
        (["--seeds", "0,1", "--set", "seed=3"], ["--set seed=3", "leave it out"]),
        (["--resume", "--set", "seed=3"], ["--set seed=3", "leave it out"]),
        (["--resume", "--seeds", "0-2"], ["seeds 0, 1, not seeds 0, 1, 2"]),
        (["--resume", "--set", "game.num_worlds=3"], ["game.num_worlds=3", "keeps its configuration"]),
        (["--resume", "--config", "OTHER"], ["game.num_goals", "keeps its configuration"]),
        (["--seeds", "0", "--run-dir", "RUN"], ["seed-0 holds a run already", "another --run-dir"]),
        (["--resume", "--seeds", "0", "--run-dir", "RUN"], ["no study in", "study.yaml"]),
        (["--seeds", "0", "--run-dir", "PARENT"], ["seed-0 holds a run already", "another --run-dir"]),
        (["--resume", "--seeds", "0", "--run-dir", "NOWHERE"], ["no study in", "--seeds"]),
        (["--parallel", "2", "--run-dir", "NOWHERE"], ["--parallel", "--seeds"]),
    ],
)
def test_mistakes_get_one_line_and_lose_nothing(begun, tmp_path, arguments, parts):
    study, _ = begun
    before = {path: path.read_bytes() for path in study.path.rglob("*") if path.is_file()}
    parent = tmp_path / "parent"  # runs without a study around them
    (parent / "seed-0").mkdir(parents=True)
    (parent / "seed-0" / "config.yaml").write_bytes((study.run(0).path / "config.yaml").read_bytes())
    other = tiny_config().model_dump(mode="json")
    other["game"]["num_goals"] += 1
    names = {
        "OTHER": write_yaml(tmp_path / "other.yaml", other),
        "RUN": study.run(0).path,
        "PARENT": parent,
        "NOWHERE": tmp_path / "nowhere",
    }
    where = [] if "--run-dir" in arguments else ["--run-dir", study.path]
    result = tandem("pretrain", *where, *(names.get(each, each) for each in arguments))
    assert result.exit_code == 2, result.output
    assert_one_line(result.stderr, "error: ", *parts)
    assert {path: path.read_bytes() for path in study.path.rglob("*") if path.is_file()} == before
    assert not (tmp_path / "nowhere").exists()


def test_two_processes_do_not_run_one_study(begun):
    study, _ = begun
    holder = StudyDirectory(study.path)
    holder.resume(tiny_config())
    try:
        result = tandem("pretrain", "--resume", "--run-dir", study.path)
    finally:
        holder.close()
    assert result.exit_code == 2
    assert_one_line(result.stderr, study.path, f"process {os.getpid()}", "stop that one first")


def test_a_study_whose_seeds_cannot_be_read(tmp_path):
    study = StudyDirectory(tmp_path)
    study.begin(tiny_config(), (0,))
    study.close()
    for text in ("no json", "{}", '{"seeds": ["a"]}', "[]"):
        study.results_file.write_text(text)
        with pytest.raises(TandemError) as error:
            study.read_seeds()
        assert_one_line(error.value, study.results_file, '"seeds"')
