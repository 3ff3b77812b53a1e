import json
import os
import shlex
import shutil
import signal

import pytest
from typer.testing import CliRunner

from service.cli.main import app
from service.downstream.directory import TrainingDirectory
from service.primitives.bundled import BUNDLED
from service.registry.registry import Registry
from service.status.run_details import setup
from service.store.disk_reader import DiskReader
from tests.downstream.trials import SETS
from tests.status.conftest import serve

CHAMPION = str(Registry(BUNDLED).resolve("panda-cube@champion"))


def invoke(*arguments):
    return CliRunner().invoke(app, ["downstream", *map(str, arguments)])


def train(*arguments):
    return invoke("train", "--steps", 600, "--episodes", 4, "--threads", 1, *SETS, *arguments)


@pytest.fixture(autouse=True)
def nowhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("TANDEM_REGISTRY", raising=False)


def test_a_signal_saves_and_the_same_command_continues(tmp_path, monkeypatch):
    record = TrainingDirectory.record
    with monkeypatch.context() as patch:
        patch.setattr(TrainingDirectory, "record", lambda *all: record(*all) or os.kill(os.getpid(), signal.SIGTERM))
        cut = train("--task", "wall")
    assert cut.exit_code == 128 + signal.SIGTERM
    assert "saved; continue with the same command and --resume" in cut.stderr
    assert "stopping after this iteration; again to end now\n" in cut.stderr
    path = tmp_path / "runs" / "downstream" / "wall-ours-0"
    assert (path / "checkpoints").exists()
    assert not (path / "result.json").exists()
    monkeypatch.setattr("service.downstream.worker._record_video", lambda *arguments: path)
    seen = DiskReader(tmp_path / "runs").run("downstream-wall-ours-0")
    assert (seen.state, seen.num_env_steps, seen.total_env_steps, seen.trial.primitives) == (
        *("interrupted", 200, 600),
        CHAMPION,
    )
    shown = setup(seen, path, tmp_path / "registry")  # what the status page gives to copy
    words = shlex.split(shown.resume_command)
    assert words[:3] == ["tandem", "downstream", "train"]
    assert sum(word == "--set" for word in words) == len(SETS)
    done = invoke(*words[2:], "--json")
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout)["env_steps"] == 600


def test_what_was_learned_is_published_evaluated_and_rendered(tmp_path, monkeypatch):
    filmed = []
    monkeypatch.setattr("service.downstream.worker._record_video", lambda *arguments: None)
    monkeypatch.setattr("service.media.video.write_episode_video", lambda *arguments: filmed.append(arguments))
    done = train("--task", "wall", "--seed", 3, "--publish", "wall-orchestrator")
    assert done.exit_code == 0, done.output
    assert "wall-orchestrator@1 is in registry" in done.stderr
    run = "runs/downstream/wall-ours-3"
    again = invoke("publish", run, "--name", "wall-orchestrator", "--alias", "best")
    assert again.stdout == f"wall-orchestrator@1 is in registry: wall, acts with {CHAMPION}\n"
    rates = {}
    for reference in (run, "wall-orchestrator@best"):
        found = invoke("evaluate", reference, "--episodes", 4, "--seed", 3, "--json")
        assert found.exit_code == 0, found.output
        rows = json.loads(found.stdout)
        assert list(rows)[2:] == [f"{CHAMPION} (bundled), Bob alone", "idle"]
        rates[reference] = list(rows.values())[1]
    result = json.loads((tmp_path / run / "result.json").read_text())["evaluation"]
    for rate in rates.values():  # the goals of its result
        assert rate == {key: result[key] for key in rate}
    drawn = invoke("render", "wall-orchestrator@best", "--task", "push", "--episodes", 2, "--out", "push.gif")
    assert drawn.exit_code == 0, drawn.output
    ((episodes, world, path, _),) = filmed
    assert (episodes.states.shape[:2], world.gripper, path.name) == ((51, 2), "blocked", "push.gif")
    for words, refused in (
        ("panda-cube is the name of primitives already", invoke("train", "--task", "wall", "--publish", "panda-cube")),
        ("without --task needs a policy of a task", invoke("evaluate", "panda-cube@champion")),
        ("unknown task 'lift'", invoke("evaluate", run, "--task", "lift")),
    ):
        assert refused.exit_code == 2
        assert refused.stderr.startswith("error: ")
        assert refused.stderr.count("\n") == 1
        assert words in refused.stderr
    assert not (tmp_path / "runs" / "downstream" / "wall-ours-0").exists()


def test_a_table_from_the_command_line(tmp_path):
    made = invoke("table", "--methods", "idle", "--tasks", "push,box", "--seeds", "0,1", "--episodes", 4, "--out", "o")
    assert made.exit_code == 0, made.output
    assert "0 of 4 trials are there, 4 to run" in made.stderr
    assert len(list((tmp_path / "o" / "downstream").iterdir())) == 4
    assert made.stdout.splitlines() == ["method\tpush\tbox", "idle\t0.0 % [0, 0] (2)\t0.0 % [0, 0] (2)"]
    again = invoke("table", "--methods", "idle", "--tasks", "push,box", "--seeds", "0,1", "--episodes", 4, "--out", "o")
    assert "4 of 4 trials are there, 0 to run" in again.stderr
    assert again.stdout == made.stdout


def test_methods_are_listed():
    listed = invoke("methods").stdout
    for name in ("ours-her", "scratch-monolithic-her", "scratch-mcp", "asp-only", "idle"):
        assert name in listed


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--task", "lift"], "unknown task 'lift'; choose one of larger, inair"),
        (["--task", "wall", "--method", "vic"], "unknown method 'vic'; choose one of ours"),
        (["--task", "wall", "--primitives", "nothing@latest"], "nothing"),
        (["--task", "wall", "--registry", "http://127.0.0.1:9"], "127.0.0.1:9"),
        (["--task", "wall", "--set", "gama=0.9"], "--set gama=0.9: write KEY=VALUE with KEY one of num_worlds"),
        (["--task", "wall", "--set", "gamma=2"], "gamma = 2: input should be less than 1"),
        (["--task", "wall", "--reward-margin-m", "0.05"], "reward_margin_m = 0.05: input should be less than 0.05"),
        (["--task", "wall", "--seed", 5_000_000_000], "seed = 5000000000: input should be less than"),
        (["--task", "wall", "--steps", 200], "200 env steps are all uniform actions"),
        (["--task", "wall", "--method", "ours-her", "--set", "num_worlds=256"], "learning_starts = 6400: goals"),
    ],
)
def test_what_is_wrong_is_one_line_and_nothing_is_written(tmp_path, arguments, words):
    refused = invoke("train", *arguments)
    assert refused.exit_code in (1, 2)
    assert refused.stderr.startswith("error: ")
    assert refused.stderr.count("\n") == 1
    assert words in refused.stderr
    assert list(tmp_path.iterdir()) == []


def test_a_registry_that_serves_a_wrong_digest(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    home = tmp_path / "home"
    (home / "runs").mkdir(parents=True)
    shutil.copytree(BUNDLED, home / "registry")
    for blob in (home / "registry" / "blobs" / "sha256").iterdir():
        blob.chmod(0o600)
        blob.write_bytes(b"x" * blob.stat().st_size)
    with serve(home) as server:
        for refused in (
            invoke("train", "--task", "wall", "--registry", server.url),
            invoke("table", "--registry", server.url),
        ):
            assert refused.stderr.startswith(f"error: {server.url} says: ")
            assert "is damaged: expected sha256" in refused.stderr
            assert refused.stderr.count("\n") == 1
    assert {path.name for path in tmp_path.iterdir()} <= {"home", "cache"}


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--seeds", "0,x"], "--seeds '0,x': write numbers"),
        (["--tasks", "wall,lift"], "unknown task 'lift'"),
        (["--methods", "ours,theirs"], "unknown method 'theirs'"),
        (["--runtime", "slurm"], "--runtime 'slurm': choose one of local, ray"),
        (["--num-workers", 2], "--num-workers needs --runtime ray"),
    ],
)
def test_a_table_that_cannot_be(tmp_path, arguments, words):
    refused = invoke("table", *arguments)
    assert refused.exit_code == 2
    assert words in refused.stderr
    assert refused.stderr.count("\n") == 1
    assert list(tmp_path.iterdir()) == []
