"""Names that are typed: configurations that come with tandem, and what a misspelt name was meant to be."""

import io
import json
import logging
import os
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
import typer
from rich.console import Console

from service.__main__ import main as command
from service.base.errors import TandemError, did_you_mean
from service.base.progress import Display
from service.base.version import __version__
from service.cli.common import quieten
from service.cli.main import app
from service.config import load_config
from service.config.recipes import CONFIGS, recipes, robots
from service.runs.named import named
from service.store.run_log import logging_to, read_log
from tests.cli.typed import assert_refused, tandem

RECIPE = CONFIGS / "pretrain" / "panda_cube.yaml"


@pytest.fixture
def begun(monkeypatch, tmp_path):
    """Configurations of runs that would have begun."""
    seen = []

    def pretrain(config, *arguments, **keywords):
        seen.append(config)
        raise TandemError("not today")

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("service.runs.train.train", pretrain)
    return seen


def test_without_a_name_it_is_the_shipped_recipe(begun):
    for arguments in ([], ["--config", "panda-cube"], ["--config", RECIPE]):
        tandem("pretrain", *arguments, "--set", "seed=3")
    assert begun == 3 * [load_config(RECIPE, ["seed=3"])]
    assert begun[0].game.num_worlds == 120  # the default is another
    tandem("pretrain", "--method", "lsd")
    tandem("train", "panda-cube-lsd")
    assert begun[3:] == 2 * [load_config(recipes()["panda-cube-lsd"])]
    assert (begun[3].method, begun[3].skills.method) == ("skills", "lsd")


def test_a_file_stands_alone_and_a_name_comes_first(begun):
    Path("panda-cube").write_text("seed: 5\n")
    tandem("pretrain", "--config", "panda-cube")
    tandem("pretrain", "--config", "./panda-cube")
    assert begun == [load_config(RECIPE), load_config(overrides=["seed=5"])]


def test_a_word_that_looks_like_a_number_or_a_date_is_a_word():
    for word in ("2024-05-01", "1e5", "on", "7"):
        _, overrides = named("push", "ours", word)
        assert load_config(overrides=overrides).primitives == word


def test_configs_are_listed_and_shown():
    rows = json.loads(tandem("configs", "--json").stdout)
    assert {row["name"]: row["kind"] for row in rows} == {
        **dict.fromkeys(recipes(), "recipe"),
        **dict.fromkeys(robots(), "robot"),
    }
    assert all(10 < len(row["about"]) < 120 for row in rows)
    assert tandem("configs").stdout.splitlines()[1].startswith("panda-cube\trecipe\tSelf-play of a Panda arm")
    assert tandem("configs", "show", "panda-cube").stdout == RECIPE.read_text()
    assert tandem("configs", "show", "ur5e").stdout == (CONFIGS / "robots" / "ur5e.yaml").read_text()


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["configs", "show", "panda_cube"], "did you mean 'panda-cube'?"),
        (["train", "--method", "paper"], "method = 'paper': choose one of "),  # which a recipe has in its name
        (["pretrain", "--config", "panda-cub"], "no recipe, task or file of that name; there are panda-cube, "),
        (["pretrain", "--set", "world.robot=ur5"], "did you mean 'ur5e'?"),
        (["pretrain", "--set", "learner.bob.num_epoch=3"], "did you mean 'num_epochs'?"),
        (["pretrain", "--set", "num_worlds=3"], "did you mean game.num_worlds?"),
        (["pretrain", "--set", "learner.gae_lambda=0.9"], "mean learner.alice.gae_lambda or learner.bob.gae_lambda?"),
        (["pretrain", "--method", "LSDD"], "did you mean 'lsd'?"),
        (["pretrain", "--runtime", "rai"], "did you mean 'ray'?"),
        (["evaluate", "panda-cube", "--goals", "tabel"], "table, air, mixed, volume, one; did you mean 'table'?"),
        (["evaluate", "panda-cube@champoin"], "did you mean 'champion'?"),
        (["train", "walls"], "did you mean 'wall'?"),
        (["train", "wall", "--method", "ours_her"], "did you mean 'ours-her'?"),
        (["train", "wall", "--set", "sac.gama=0.9"], "did you mean 'gamma'?"),
        (["evalute"], "Did you mean 'evaluate'?"),
    ],
)
def test_what_was_meant_is_said(monkeypatch, tmp_path, arguments, said):
    monkeypatch.chdir(tmp_path)
    assert_refused(tandem(*arguments), said)
    assert list(tmp_path.iterdir()) == []


def test_what_is_like_nothing_gets_no_guess():
    assert did_you_mean("zebra", ["panda-cube", "ur5e"]) == ""
    assert did_you_mean("x" * 100_000, ["panda-cube"]) == ""


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        *(
            ([option], f"{option.partition('=')[0]} is for a run on Ray: give --runtime ray")
            for option in (
                *("--address=auto", "--num-actors=2", "--actor-threads=1", "--learner-cpus=1", "--status=off"),
                "--token-file=x",
            )
        ),
        (["--runs", "a", "--run-dir", "b"], "--runs is where --run-dir would be: drop one of them"),
        (["--runtime", "ray", "--status", "off", "--token-file", "x"], "--token-file is for the service that"),
        (["--run-id", "x", "--resume"], "--resume is what --run-id says already"),
        (["--run-id", "x", "--run-dir", "y"], "--run-dir is what --run-id says already"),
        (["--resume", "--run-dir", "x", "--from", "panda-cube"], "--from is for a run that begins"),
        (["panda-cube", "--config", "x.yaml"], "name one of them"),
    ],
)
def test_options_that_would_do_nothing_are_refused(monkeypatch, tmp_path, arguments, said):
    monkeypatch.chdir(tmp_path)
    assert_refused(tandem("pretrain", *arguments), said)
    assert list(tmp_path.iterdir()) == []
    assert "only the world" in tandem("evaluate", "panda-cube@champion", "--set", "seed=3").stderr


def test_what_takes_long_can_be_quiet():
    root = typer.main.get_command(app)
    for line in (
        "train", "pretrain", "demo", "evaluate", "coverage", "render", "play", "dataset", "export", "publish", "serve",
    ):  # fmt: skip
        command = root
        for word in line.split():
            command = command.commands[word]
        assert any("-q" in each.opts for each in command.params), line


def test_quiet_before_and_after_the_command(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("service.base.progress.PLAIN_INTERVAL_S", 0.0)
    typed = ["evaluate", "panda-cube@champion", "--episodes", "1", "--steps", "1"]
    assert "evaluating on mixed goals" in tandem(*typed).stderr
    monkeypatch.setattr(logging.getLogger(), "handlers", [])
    for arguments in (["-q", *typed], [*typed, "-q"]):
        done = tandem(*arguments)
        assert (done.exit_code, done.stderr) == (0, "")
        assert "at the last step" in done.stdout


def test_what_quiet_does_not_print_is_in_the_log_of_the_run(monkeypatch, tmp_path, caplog):
    printed = io.StringIO()
    monkeypatch.setattr(logging.getLogger(), "handlers", [logging.StreamHandler(printed)])
    with caplog.at_level(logging.INFO), Display(Console(file=io.StringIO())), logging_to(tmp_path):  # as in main
        quieten(True)
        logging.getLogger("service.cluster").info("rollout actor 3 is back")
        logging.getLogger("service.cluster").warning("rollout actor 3 is gone")
    assert [line.text for line in read_log(tmp_path)] == ["rollout actor 3 is back", "rollout actor 3 is gone"]
    assert printed.getvalue() == "rollout actor 3 is gone\n"


def test_ctrl_c_while_the_command_is_loaded_is_quiet(monkeypatch):
    class Interrupted:
        @staticmethod
        def find_spec(name, *_):
            if name == "service.cli.main":
                raise KeyboardInterrupt

    monkeypatch.delitem(sys.modules, "service.cli.main")
    monkeypatch.setattr(sys, "meta_path", [Interrupted, *sys.meta_path])
    with pytest.raises(SystemExit) as ended:
        command()
    assert ended.value.code == 130


def test_the_version():
    assert tandem("--version").stdout == f"tandem {__version__}\n"


def test_the_shell_completes_names():
    typed = ["tandem", "pretrain", "--config", "pan"]
    asked = {"_TANDEM_COMPLETE": "complete_bash", "COMP_WORDS": shlex.join(typed), "COMP_CWORD": "3"}
    code = "import sys; sys.argv = ['tandem']; from service.cli.main import main; main()"
    done = subprocess.run(
        [sys.executable, "-c", code], env={**os.environ, **asked}, capture_output=True, text=True, timeout=600
    )
    assert done.stdout.split() == list(recipes()), done.stderr
