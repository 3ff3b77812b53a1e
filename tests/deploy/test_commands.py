"""Every command in manifests and documents is one that this tandem and this Ray take."""

import re
import shlex
from contextlib import nullcontext
from pathlib import Path

import pytest
import typer

from service.cli.main import app
from service.config import dump_config
from service.config.recipes import recipes
from service.runs.study import Study
from service.runs.study_run import Place
from service.store.checkpoints import CheckpointStore
from service.store.run_history import RunHistory
from tests.cli.typed import tandem
from tests.deploy.files import DEPLOY, DOCUMENTS, commands, compose, container, manifest, manifests, pod_templates

BEGIN = ("train", "pretrain")
"""The second is what version 0.2 documented."""


def tandem_commands():
    """Where a call of tandem stands, and its arguments."""
    status = container(manifest("Deployment", "status")["spec"]["template"], "status")
    found = [
        ("compose status", compose()["services"]["status"]["command"]),
        ("kubernetes status", status["args"]),
        ("rayjob", shlex.split(manifest("RayJob", "cube")["spec"]["entrypoint"])[1:]),
    ]
    texts = [*DOCUMENTS, DEPLOY / "compose" / "compose.yaml"]
    found += [(path.name, arguments) for path in texts for arguments in commands(path.read_text(), "tandem")]
    found += [
        ("0.2", shlex.split("pretrain --runtime ray --address auto --status off --run-id cube")),
        ("0.2", shlex.split("pretrain --runtime ray --address auto --run-id study --seeds 0-4")),
    ]
    return [pytest.param(arguments, id=f"{where}: {' '.join(arguments)[:60]}") for where, arguments in found]


def ray_commands():
    nodes = [each["command"] for each in compose()["services"].values() if each.get("entrypoint") == ["ray"]]
    found = [("compose", [re.sub(r"\$\{\w+:-(\w+)\}", r"\1", word) for word in command]) for command in nodes]
    for name, spec in (
        ("raycluster", manifest("RayCluster", "tandem")["spec"]),
        ("rayjob", manifest("RayJob", "cube")["spec"]["rayClusterSpec"]),
    ):
        groups = [spec["headGroupSpec"], *spec["workerGroupSpecs"]]
        found += [
            (name, ["start", *(f"--{key}={value}" for key, value in each["rayStartParams"].items())]) for each in groups
        ]
    texts = [*DOCUMENTS, DEPLOY / "compose" / "compose.yaml"]
    found += [(path.name, arguments) for path in texts for arguments in commands(path.read_text(), "ray")]
    return [pytest.param(arguments, id=f"{where}: {' '.join(arguments)[:60]}") for where, arguments in found]


def parse(group, arguments):
    """Parse a command line as its program would, down to the last subcommand, without running it."""
    while hasattr(group, "commands"):
        name, *arguments = arguments
        assert name in group.commands, f"there is no {name}, only {', '.join(group.commands)}"
        group = group.commands[name]
    group.make_context(group.name, list(arguments))


@pytest.mark.parametrize("arguments", tandem_commands())
def test_tandem_takes_it(arguments):
    parse(typer.main.get_command(app), arguments)


@pytest.mark.parametrize("arguments", ray_commands())
def test_ray_takes_it(arguments):
    from ray.scripts.scripts import cli

    parse(cli, arguments)


@pytest.mark.parametrize("arguments", [each for each in tandem_commands() if each.values[0][0] in BEGIN])
def test_a_run_begins_with_it_and_goes_on_with_it(arguments, monkeypatch, tmp_path):
    """Up to where a run would begin: options that exclude each other are found out only then."""
    begun = []

    def train(config, directory, registry, *, resume, **kwargs):
        begun.append((directory.path, resume))
        CheckpointStore(directory.checkpoints, keep=1).save(0, {}, {})
        RunHistory.new().write(directory.path)
        directory.config_file.write_text(dump_config(config))

    def begin(study, *arguments):
        begun.append((study.path, resumed))

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("service.cli.train.train_and_tell", train)
    monkeypatch.setattr(Study, "train", begin)
    monkeypatch.setattr("service.cli.study._on_ray", lambda *_: Place())
    monkeypatch.setattr("service.cluster.ray_connection.connected", lambda *_: nullcontext())
    here, resumed = list(arguments), False
    for resumed in (False, True):
        result = tandem(*here)
        assert result.exit_code == 0, result.output
        assert begun.pop() == (Path("runs/study" if "--seeds" in here else "runs/cube"), resumed)


def test_a_wrong_option_is_found():
    from ray.scripts.scripts import cli

    with pytest.raises(Exception, match="--num-cpu"):
        parse(cli, ["start", "--num-cpu=0"])
    with pytest.raises(Exception, match="--run-dirr"):
        parse(typer.main.get_command(app), ["pretrain", "--run-dirr", "x"])
    with pytest.raises(AssertionError, match="there is no server"):
        parse(typer.main.get_command(app), ["server"])


def test_commands_are_found_in_text():
    text = "ray job submit --no-wait \\\n  -- tandem pretrain --run-dir runs/x  # why\n#   tandem serve --port 1\n"
    assert commands(text, "tandem") == [["pretrain", "--run-dir", "runs/x"], ["serve", "--port", "1"]]
    assert commands(text, "ray") == [["job", "submit", "--no-wait", "--", "tandem", "pretrain", "--run-dir", "runs/x"]]
    assert len(tandem_commands()) > 5
    assert len(ray_commands()) > 8


def test_configurations_that_are_named_are_in_the_image():
    named = {
        word
        for each in tandem_commands()
        for option, word in zip(each.values[0], each.values[0][1:], strict=False)
        if option == "--config"
    }
    assert named == {"panda-cube"}
    assert named <= set(recipes())  # which are in the wheel


def test_ray_containers_leave_the_command_to_the_operator():
    for template in pod_templates(manifests()):
        for box in template["spec"]["containers"]:
            assert not (box["name"].startswith("ray-") and {"command", "args"} & set(box))
