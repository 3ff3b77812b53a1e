"""A task from the command line: learned, gone on with, measured, filmed and published."""

import json
import os
import signal

import pytest

from service.base.lock import DirectoryLock
from service.config.find import METHODS
from service.registry.bundled import BUNDLED
from service.registry.registry import Registry
from service.store.models import read_status
from service.store.run_directory import RunDirectory
from tests.cli.typed import assert_refused, tandem
from tests.runs.runs import play

CHAMPION = str(Registry(BUNDLED).resolve("panda-cube@champion"))
SETS = [
    f"--set={setting}"
    for setting in (
        *("sac.num_worlds=4", "sac.gradient_steps=2", "sac.batch_size=16", "sac.learning_starts=200"),
        *("sac.hidden_sizes=[8]", "run.total_env_steps=600", "run.final_episodes=4", "run.num_threads=1"),
    )
]
"""Three iterations of 200 env steps; the second and third learn."""


@pytest.fixture(autouse=True)
def nowhere(tmp_path, monkeypatch, no_artifacts):
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("TANDEM_REGISTRY", raising=False)


@pytest.fixture(scope="module")
def learned(tmp_path_factory):
    """Where a run has learned Wall with seed 3."""
    home = tmp_path_factory.mktemp("home")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(home)
        patch.setattr("service.runs.train.make_artifacts", lambda directory, registry: {})
        done = tandem("train", "wall", "--primitives", "panda-cube@champion", "--set", "seed=3", *SETS)
    assert done.exit_code == 0, done.output
    assert "evaluation/mean_distance_m" in done.stdout
    assert done.stdout.endswith("\ntry it:      tandem play runs/wall-ours-3\n")
    return home


def test_resume_auto_begins_a_run_and_goes_on_with_it(tmp_path, monkeypatch):
    command = ("train", "wall", "--method", "ours-her", "--resume", "auto", *SETS)
    record = RunDirectory.record
    with monkeypatch.context() as patch:
        patch.setattr(RunDirectory, "record", lambda *all: record(*all) or os.kill(os.getpid(), signal.SIGTERM))
        cut = tandem(*command)
    assert cut.exit_code == 128 + signal.SIGTERM, cut.output
    path = tmp_path / "runs" / "wall-ours-her-0"
    assert f"continue with: tandem train --resume --run-dir {path.relative_to(tmp_path)}" in cut.stdout
    assert RunDirectory(path).read_result() is None
    done = tandem(*command)
    assert done.exit_code == 0, done.output
    rows = [json.loads(line)["env_steps"] for line in (path / "metrics.jsonl").read_text().splitlines()]
    assert rows == [200, 400, 600]
    config, result = RunDirectory(path).read_config(), RunDirectory(path).read_result()
    assert (config.primitives, config.task_version, result["env_steps"]) == (CHAMPION, 1, 600)
    # its method is that of the run, though another one would be the task's first
    more = tandem("train", "wall", "--resume", "--run-dir", path, "--set", "run.total_env_steps=800")
    assert "finished after 800 env steps" in more.stdout
    assert "nothing was left" not in more.stdout
    again = tandem("train", "--resume", "--run-dir", path)
    assert "nothing was left to learn: run.total_env_steps is 800; raise it by --set to go on" in again.stdout
    assert_refused(tandem(*command, "--run-dir", path, "--set", "task=push"), "task = 'push', but the run has 'wall'")
    assert_refused(tandem("train", "push", "--resume=often"), "--resume 'often': choose one of auto, exactly")


def test_what_was_learned_is_published_measured_and_filmed(learned, monkeypatch):
    filmed = []
    monkeypatch.chdir(learned)
    monkeypatch.setattr("service.media.video.write_episode_video", lambda *arguments: filmed.append(arguments))
    run = "runs/wall-ours-3"
    for _ in range(2):  # the second time nothing new is made
        done = tandem("publish", run, "--name", "wall-orchestrator", "--alias", "best")
        assert done.stdout == "wall-orchestrator@1 is in registry\n", done.output
    assert read_status(learned / run).published == "wall-orchestrator@1"  # so the page says it
    manifest = Registry(learned / "registry").manifest("wall-orchestrator@1")
    result = json.loads((learned / run / "result.json").read_text())["evaluation"]
    assert manifest.metrics == {f"evaluation/{key}": value for key, value in result.items()} | {"env_steps": 600}
    assert (manifest.spaces["kind"], manifest.spaces["primitives"]) == ("orchestrator", CHAMPION)
    for reference in (run, "wall-orchestrator@best"):
        found = tandem("evaluate", reference, "--episodes", 4, "--seed", 3, "--json")
        assert found.exit_code == 0, found.output
        rows = json.loads(found.stdout)
        assert list(rows)[2:] == [f"{CHAMPION} (bundled), Bob alone", "idle"]
        row = list(rows.values())[1]
        assert {key: row[key] for key in row if key != "goals"} == {key: result[key] for key in row if key != "goals"}
    drawn = tandem("render", "wall-orchestrator@best", "--task", "push", "--episodes", 2, "--out", "push.gif")
    assert drawn.exit_code == 0, drawn.output
    ((episodes, world, path, _),) = filmed
    assert (episodes.states.shape[:2], world.gripper, path.name) == ((51, 2), "blocked", "push.gif")
    for words, arguments in (
        ("panda-cube is the name of primitives already", ("publish", run, "--name", "panda-cube")),
        ("unknown task 'lift'", ("evaluate", run, "--task", "lift")),
        ("has learned, and its run has the result.json", ("evaluate", run, "--out", "o.json")),
        ("bad name 'No Name'", ("publish", run, "--name", "No Name")),
        ("is a service; give the directory of a registry", ("publish", run, "--registry", "http://127.0.0.1:9")),
        ("no run in panda-cube@champion", ("publish", "panda-cube@champion")),
    ):
        assert_refused(tandem(*arguments), words)


def test_an_interrupted_run_is_published_and_a_running_one_is_not(tmp_path):
    play(tmp_path / "run", kill_after=3)
    lock = DirectoryLock(tmp_path / "run")
    assert_refused(tandem("publish", "run", "--name", "early"), f"is in use by process {os.getpid()}")
    lock.release()
    done = tandem("publish", "run", "--name", "early")
    assert done.stdout == "early@1 is in registry\n", done.output
    manifest, directory = Registry(tmp_path / "registry").manifest("early@1"), RunDirectory(tmp_path / "run")
    assert manifest.config["name"] == "early"
    saved = json.loads((tmp_path / "run" / "metrics.jsonl").read_text().splitlines()[1])  # every second is saved
    assert manifest.metrics["env_steps"] == saved["env_steps"]
    assert 0.0 <= manifest.metrics["evaluation/mixed_success_last"] <= 1.0
    assert directory.read_published().version == "early@1"
    assert directory.epoch == 0
    again = tandem("train", "--resume", "--run-dir", "run")  # it may go on, and publishes by its own name
    assert "tiny@1 in registry" in again.stdout, again.output
    assert Registry(tmp_path / "registry").manifest("tiny@1").parent == "early@1"


def test_what_learns_nothing_is_measured_as_a_run_is(tmp_path, monkeypatch):
    written = {}
    for method in ("idle", "asp-only"):
        done = tandem("evaluate", "--task", "push", "--method", method, "--episodes", 8, "--out", f"o/{method}.json")
        assert done.exit_code == 0, done.output
        assert "8 random goals of Push (table)" in done.stdout
        written[method] = json.loads((tmp_path / "o" / f"{method}.json").read_text())
    idle, bob = written.values()
    assert (idle["task"], idle["method"], idle["seed"], idle["primitives"], idle["env_steps"]) == (
        *("push", "idle", 0, None, 0),
    )
    assert (bob["primitives"], len(bob["primitives_digest"])) == (CHAMPION, 64)
    assert bob["evaluation"]["success_last"] > idle["evaluation"]["success_last"]
    assert idle["evaluation"].keys() == {
        "num_episodes", "num_steps", "mean_distance_m",
        *(f"success_{each}{end}" for each in ("last", "ever") for end in ("", "_low", "_high")),
    }  # fmt: skip
    rows = json.loads(tandem("evaluate", "panda-cube", "--task", "push", "--episodes", 8, "--json").stdout)
    assert rows["idle"]["mean_distance_m"] == idle["evaluation"]["mean_distance_m"]
    assert rows[f"{CHAMPION} (bundled)"]["mean_distance_m"] == bob["evaluation"]["mean_distance_m"]
    monkeypatch.setattr("service.actors.evaluation.evaluate", None)  # nothing is played
    for words, arguments in (
        ("o/idle.json is there already", ("--task", "push", "--method", "idle", "--out", "o/idle.json")),
        ("idle.json is no directory", ("--task", "push", "--method", "idle", "--out", "o/idle.json/x")),
        ("--method is for a task", ("--method", "idle")),
        ("--out is for a task", ("--out", "x.json")),
        ("--method ours learns: tandem train", ("--task", "push", "--method", "ours")),
        ("unknown method 'idel'", ("--task", "push", "--method", "idel")),
        ("acts by skills", ("--task", "push", "--method", "lsd-zero-shot")),
    ):
        assert_refused(tandem("evaluate", *arguments), words)


def test_methods_and_tasks_are_listed():
    methods = {row["name"]: row for row in json.loads(tandem("methods", "--json").stdout)}
    assert methods.keys() >= METHODS.keys()
    assert {name for name, row in methods.items() if row["learns"] == "nothing"} == methods.keys() - METHODS.keys()
    assert methods["self-play"]["learns"] == "pre-training"
    assert all(5 < len(row["about"]) < 110 for row in methods.values())
    listed = tandem("tasks").stdout.splitlines()
    assert [line.partition("\t")[0] for line in listed[:3]] == ["name", "larger", "inair"]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["lift"], "'lift': no recipe, task or file of that name"),
        (["metra"], "did you mean panda-cube-metra?"),
        (["ours-her"], "ours-her is a method of tasks: tandem train push --method ours-her"),
        (["wall", "--method", "vic"], "--method vic: of a task choose one of ours, ours-her, "),
        (["wall", "--method", "idle"], "idle learns nothing: measure it by tandem evaluate --task wall --method idle"),
        (["--method", "ours"], "--method ours is for a task"),
        (
            ["panda-cube", "--method", "lsd"],
            "its method itself: leave out --method, or leave out panda-cube",
        ),
        (["panda-cube", "--primitives", "panda-cube"], "--primitives is for learning a task"),
        (["wall", "--primitives", "nothing@latest"], "nothing"),
        (["wall", "--from", "panda-cube@champion"], "--from is for self-play and distillation"),
        (["--method", "lsd", "--from", "panda-cube@champion"], "--from is for self-play; skill discovery begins anew"),
        (["wall", "--method", "lsd"], "such as panda-cube-lsd@latest, which tandem train --method lsd makes"),
        (["wall", "--runtime", "ray", "--status", "off"], "method = ours: it runs in one process"),
        (["wall", "--resume"], "--resume needs --run-dir"),
        (["wall", "--set", "gamma=0.9"], "did you mean sac.gamma?"),
        (["wall", "--set", "sac.gamma=2"], "gamma = 2: Input should be less than 1"),
        (["wall", "--set", "reward_margin_m=0.05"], "reward_margin_m = 0.05: Input should be less than 0.05"),
        (["wall", "--set", "seed=5000000000"], "seed = 5000000000: Input should be less than"),
        (
            ["wall", "--set", "run.total_env_steps=200"],
            "run.total_env_steps = 200 has to be more than sac.l",
        ),
        (["wall", "--set", "episode_steps=20"], "episode_steps = 20: the task wall says 50; leave it out"),
        (["wall", "--method", "ours-her", "--set", "sac.num_worlds=256"], "sac.learning_starts = 6400: goals"),
        (["wall", "--method", "scratch-mcp", "--publish"], "acts with no primitives: there is nothing to publish"),
        (["wall", "--publish", "--set", "name=panda-cube"], "panda-cube is the name of primitives already"),
    ],
)
def test_what_is_wrong_is_one_line_and_nothing_is_written(tmp_path, arguments, words):
    assert_refused(tandem("train", *arguments), words)
    assert list(tmp_path.iterdir()) == []


def test_a_service_that_does_not_answer_is_no_mistake_of_what_was_typed(tmp_path):
    assert_refused(
        tandem("train", "wall", "--registry", "http://127.0.0.1:9"), "cannot reach http://127.0.0.1:9", code=1
    )
    assert list(tmp_path.iterdir()) == []
