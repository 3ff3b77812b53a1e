"""The command line as typed: one whole pre-training and what can be done with it, and what a mistake gets."""

import json
import os
import re
import shlex
import signal
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import pytest

import service
from service.base.errors import TandemError
from service.base.lock import DirectoryLock
from service.cli.evaluate import parse_goals
from service.config import WorldConfig, load_config
from service.config.recipes import recipes
from service.media import artifacts
from service.media.video import FilmOptions
from service.methods import task_evaluation  # noqa: F401  before the function that it calls is replaced
from service.registry.bundled import BUNDLED
from service.registry.registry import Registry
from service.runs.signals import InterruptError
from service.runs.study import Study
from service.runs.study_run import Place
from service.store.run_directory import RunDirectory
from tests.cli.typed import assert_refused, tandem
from tests.runs.runs import TREE, assert_one_line, no_room_above, tiny_config, write_yaml

ROOT = Path(__file__).parents[2]
EXAMPLES = (ROOT / "docs" / "cli.md").read_text()
EVALUATION_KEYS = {
    "goals", "num_episodes", "num_steps", "success_last", "success_last_low", "success_last_high", "success_ever",
    "mean_distance_m",
}  # fmt: skip


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A tiny pre-training from the command line: its directory, its registry, and what was printed."""
    home = tmp_path_factory.mktemp("home")
    config = write_yaml(home / "tiny.yaml", TREE | {"run": TREE["run"] | {"total_env_steps": 900}})
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("service.media.artifacts.NUM_RECORDED_ROUNDS", 1)
        patch.setattr("service.media.artifacts.COVERAGE_STEPS", 20)
        small = FilmOptions(width=320, height=180)
        patch.setattr("service.media.artifacts.film", partial(artifacts.film, options=small))
        result = tandem(
            "pretrain", "--config", config, "--run-dir", home / "run", "--registry", home / "registry",
            "--set", "run.keep_checkpoints=2",
        )  # fmt: skip
    return SimpleNamespace(result=result, home=home, run=home / "run", registry=home / "registry")


# --- pretrain --------------------------------------------------------------------------------------------------------


def test_pretrain_leaves_everything_a_person_looks_at_and_says_where(trained):
    assert trained.result.exit_code == 0, trained.result.output
    out = trained.result.stdout
    for name in ("curves", "goals", "coverage"):
        data = (trained.run / f"{name}.png").read_bytes()
        assert data[:8] == b"\x89PNG\r\n\x1a\n"
        assert len(data) > 10_000
        assert str(trained.run / f"{name}.png") in out
    assert len(list((trained.run / "tensorboard").iterdir())) == 1
    assert len(list((trained.run / "checkpoints").iterdir())) == 2
    assert load_config(trained.run / "config.yaml") == tiny_config(total_env_steps=900, keep_checkpoints=2)
    steps = json.loads((trained.run / "metrics.jsonl").read_text().splitlines()[-1])["env_steps"]
    assert f"finished after {steps:,} env steps" in out
    assert f"tiny@1 in {trained.registry}" in out
    for word in (
        "evaluation/table_success_last",
        "total",
        "play",
        "wait for learner",
        str(trained.run / "checkpoints"),
    ):
        assert word in out
    before = (trained.run / "metrics.jsonl").read_bytes()
    assert_refused(tandem("pretrain", "--run-dir", trained.run), trained.run, "--resume")
    assert (trained.run / "metrics.jsonl").read_bytes() == before


def test_pretrain_films_rounds_where_pictures_can_be_drawn(trained):
    from service.envs.rendering.renderer import SceneRenderer

    video = trained.run / "rounds.mp4"
    try:
        SceneRenderer(tiny_config().world, 64, 48).close()
    except TandemError as error:
        if not str(error).startswith("cannot draw"):
            raise
        assert "rounds.mp4" not in trained.result.stdout
        pytest.skip("videos need OpenGL: EGL or OSMesa, apt-get install libegl1")
    assert str(video) in trained.result.stdout
    assert video.read_bytes()[4:8] == b"ftyp"


@pytest.fixture
def asked(monkeypatch, tmp_path):
    """Configuration, directory, registry and options of runs that would have begun, in a directory of their own."""
    seen = []

    def train(config, directory, registry, **options):
        seen.append((config, directory.path, registry, options))
        directory.path.mkdir(parents=True, exist_ok=True)
        raise KeyboardInterrupt

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("service.runs.train.train", train)
    return seen


@pytest.mark.usefixtures("no_artifacts")
def test_the_examples_of_pretraining(monkeypatch, tmp_path):
    """As they stand there, one after the other, with a tiny configuration where the shipped one would be.

    What they do with ``--runtime ray`` is shown in tests/runs and tests/cluster.
    """
    monkeypatch.chdir(tmp_path)
    commands = [
        shlex.split(line, comments=True) for line in re.findall(r"^\$ tandem (train .*)$", EXAMPLES, re.MULTILINE)
    ]
    commands = [command for command in commands if "--runtime" not in command and command[1] != "wall"]
    write_yaml(tmp_path / "tiny.yaml", TREE | {"name": "panda-cube"})
    monkeypatch.setitem(recipes(), "panda-cube", tmp_path / "tiny.yaml")
    for command in commands:
        result = tandem(*command)
        assert result.exit_code == 0, (command, result.output)
        assert "finished after" in result.stdout
    assert any("--resume" in command for command in commands)
    assert sorted(path.name for path in Path("runs").iterdir()) == ["cube", "panda-sphere"]
    rows = json.loads(tandem("registry", "list", "--json").stdout)
    own = [(row["name"], row["version"], row["parent"]) for row in rows if row["where"] == "yours"]
    assert own == [("panda-cube", 1, None), ("panda-sphere", 1, None)]  # resuming what was finished made no version
    few = ("--episodes", 2, "--steps", 2, "--json")  # after which the bundled primitives are still there
    evaluated = json.loads(tandem("evaluate", "panda-cube@champion", *few).stdout)
    assert list(evaluated) == [f"{Registry(BUNDLED).resolve('panda-cube@champion')} (bundled)", "idle"]
    evaluated = json.loads(tandem("evaluate", "panda-cube", *few).stdout)
    assert list(evaluated) == ["panda-cube@1", "idle"]


def test_a_resumed_run_takes_the_file_it_was_begun_with(trained, asked):
    given = ("--resume", "--run-dir", trained.run, "--config", trained.home / "tiny.yaml")
    tandem("pretrain", *given, "--set", "run.total_env_steps=950")
    ((config, _, _, options),) = asked
    assert (config.run, options["resume"]) == (tiny_config(total_env_steps=950, keep_checkpoints=2).run, True)


def test_pretrain_goes_to_runs_by_its_name(asked):
    tandem("pretrain", "--set", "name=blue")
    tandem("pretrain", "--set", "name=blue", "--run-dir", "here", TANDEM_REGISTRY="/there")
    tandem("pretrain", "--set", "name=blue", "--runs", "jobs", "--run-id", "7")
    assert [(config.name, path, registry, options["resume"]) for config, path, registry, options in asked] == [
        ("blue", Path("runs/blue"), "registry", False),
        ("blue", Path("here"), "/there", False),
        ("blue", Path("jobs/7"), "registry", False),
    ]


def test_demo_is_a_short_pretraining_with_a_registry_of_its_own(asked):
    tandem("demo", "--no-browser", "--env-steps", "7")
    tandem("demo", "--no-browser", "--env-steps", "8", "--seed", "3")
    one, two = Path("runs/demo-1"), Path("runs/demo-2")
    assert [(path, registry, config.run.total_env_steps) for config, path, registry, _ in asked] == [
        (one, one / "registry", 7),
        (two, two / "registry", 8),
    ]
    configs = [each[0] for each in asked]
    assert [(each.name, each.seed) for each in configs] == [("panda-cube-demo", 0), ("panda-cube-demo", 3)]
    assert (configs[0].run.evaluation_interval, configs[0].run.checkpoint_interval) == (60, 10)
    (one / "config.yaml").touch()
    refused = tandem("demo", "--run-dir", one)
    assert_refused(refused, "or continue with: tandem train --resume --run-dir runs/demo-1", "runs/demo-1/registry")


@pytest.mark.parametrize(
    ("reason", "minutes", "said"),
    [
        ("converged", "0.5", "Bob solves four of five random goals, twice in a row"),
        ("converged", "0.5", "It is converged"),  # by the task generator's criterion
        ("finished", "0.5", "It is finished"),
        ("finished", "0", "0 minutes are over"),
    ],
)
def test_demo_ends_with_why_and_what_to_type(monkeypatch, tmp_path, reason, minutes, said):
    from service.runs.train import Finished

    def pretrain(*args, on_iteration, **kwargs):
        rate = 0.84 if "twice" in said else 0.79
        for _ in range(2):
            on_iteration({"env_steps": 7.0, "iteration": 1.0, "evaluation/mixed_success_last": rate})
        return Finished(reason, 1, 7, "total 1 s", {}, None, {"evaluation/mixed_success_last": 0.84})

    monkeypatch.setattr("service.runs.train.train", pretrain)
    monkeypatch.chdir(tmp_path)
    result = tandem("demo", "--no-browser", "--minutes", minutes)
    assert result.exit_code == 0, result.output
    assert f"{said}. Of 300 others he solves 84%." in result.stdout
    commands = [shlex.split(line)[1:] for line in re.findall(r"^ +(tandem .*)$", result.stdout, re.MULTILINE)]
    champion = "panda-cube@champion"
    shown = [["play", "runs/demo-1"], ["serve", "--runs"], ["play", champion], ["evaluate", champion]]
    assert [command[:2] for command in commands] == shown


def test_demo_ends_when_bob_is_good_twice_in_a_row_or_the_time_is_over(monkeypatch):
    from service.cli import demo

    now = [100.0]
    monkeypatch.setattr(demo.time, "monotonic", lambda: now[0])
    until = demo.Until(2.0)
    rates = (None, 0.8, 0.79, None, 0.8, None, 0.85)
    found = [until({} if rate is None else {"evaluation/mixed_success_last": rate}) for rate in rates]
    assert found == [None] * 6 + ["converged"]
    until = demo.Until(2.0)
    now[0] = 219.9
    assert until({}) is None
    now[0] = 220.0
    assert until({"evaluation/mixed_success_last": 0.9}) == "finished"


@pytest.mark.parametrize("seeds", [(), ("--seeds", "0,1")])
def test_what_is_wrong_with_the_directory_or_with_ray_is_said_and_leaves_nothing(tmp_path, monkeypatch, seeds):
    arguments = ("pretrain", "--run-dir", tmp_path / "run", *seeds, "--runtime", "ray")
    result = tandem(*arguments, "--address", "127.0.0.1:1")
    assert_refused(result, "error: --address 127.0.0.1:1: no Ray cluster answers there", code=1)
    assert list(tmp_path.iterdir()) == []
    monkeypatch.setattr("service.cluster.ray_connection.connected", lambda address: pytest.fail("it takes a minute"))
    lock = DirectoryLock(tmp_path / "run")
    assert_refused(tandem(*arguments, "--status", "off"), tmp_path / "run", f"in use by process {os.getpid()} on ")
    lock.release()


@pytest.fixture
def stopped_at_once(monkeypatch):
    """A signal ends every training as it begins."""

    def stop(config, directory, *arguments, **keywords):
        directory.config_file.parent.mkdir(exist_ok=True)
        directory.config_file.touch()  # so it has begun
        interrupt()

    def interrupt(*_):
        raise InterruptError(signal.SIGTERM)

    monkeypatch.setattr("service.runs.train.train", stop)
    monkeypatch.setattr(Study, "train", interrupt)


@pytest.mark.parametrize(
    ("options", "hint"),
    [
        ((), ""),
        (("--publish",), " --publish"),
        (("--no-publish",), " --no-publish"),
        (
            ("--status", "off", "--address", "head:6379", "--runtime", "ray"),
            " --runtime ray --address head:6379 --status off",
        ),
        (("--tracker", "logging:LoggerAdapter"), " --tracker logging:LoggerAdapter"),
        (("--set", "seed=3", "--quiet"), ""),  # the run's files have the one, the other changes nothing in it
    ],
)
@pytest.mark.parametrize("seeds", [(), ("--seeds", "0,1")])
@pytest.mark.usefixtures("stopped_at_once")
def test_how_to_go_on_has_the_options_that_no_file_of_the_run_has(tmp_path, monkeypatch, options, hint, seeds):
    if seeds:
        options = [each if each != "seed=3" else "run.num_threads=1" for each in options]
    monkeypatch.setattr("service.cluster.ray_connection.connected", lambda address: nullcontext())
    monkeypatch.setattr("service.cli.study._on_ray", lambda *_: Place())
    result = tandem("pretrain", "--run-dir", tmp_path / "a run", "--registry", "registry", *seeds, *options)
    assert result.exit_code == 128 + signal.SIGTERM, result.exception
    how = f"continue with: tandem train --resume --run-dir '{tmp_path}/a run' --registry registry{hint}\n"
    assert result.stdout == f"stopped at once; {how}"


@pytest.mark.usefixtures("stopped_at_once")
def test_how_to_go_on_publishes_a_policy_of_a_task_only_if_that_was_typed(tmp_path):
    asked = ("train", "push", "--registry", "registry", "--run-dir", tmp_path / "run")
    for typed in (["--publish"], ["--no-publish"], []):
        result = tandem(*asked, *typed)
        assert result.stdout.endswith(" ".join([" --registry registry", *typed]) + "\n"), result.output


# --- what can be done with it ----------------------------------------------------------------------------------------


def evaluate(trained, primitives, *arguments):
    few = ("--episodes", 8, "--steps", 2)
    return tandem("evaluate", primitives, "--registry", trained.registry, *few, *arguments)


def test_evaluate_published_primitives_and_their_run(trained):
    result = evaluate(trained, "tiny@latest", "--goals", "table", "--json")
    assert result.exit_code == 0, result.output
    rows = json.loads(result.stdout)
    assert list(rows) == ["tiny@1", "idle"]
    for row in rows.values():
        assert set(row) == EVALUATION_KEYS
        assert (row["goals"], row["num_episodes"], row["num_steps"]) == ("table", 8, 2)
        assert 0.0 <= row["success_last_low"] <= row["success_last"] <= row["success_last_high"] <= 1.0
    assert rows["tiny@1"]["mean_distance_m"] != rows["idle"]["mean_distance_m"]
    from_run = json.loads(evaluate(trained, trained.run, "--goals", "table", "--json").stdout)
    assert from_run == {str(trained.run): rows["tiny@1"], "idle": rows["idle"]}
    other = json.loads(evaluate(trained, "tiny", "--goals", "table", "--json", "--seed", 1).stdout)
    assert other["idle"] != rows["idle"]


def test_episodes_are_as_long_as_the_run_evaluated_them(trained):
    """The same as ``service.evaluate``, which has no other length."""
    words = ("evaluate", "tiny", "--registry", trained.registry, "--episodes", 2, "--goals", "table", "--json")
    bob = service.load("tiny", registry=trained.registry)
    assert bob.num_steps == bob.config.run.evaluation_steps != 50
    assert json.loads(tandem(*words).stdout)["idle"]["num_steps"] == bob.num_steps


def test_evaluate_in_a_world_of_another_layout_is_refused(trained):
    result = evaluate(trained, "tiny", "--set", "world.observed.num_commands=1")
    assert_refused(result, "--set", "tiny@1", "command_1", "world.observed")
    assert evaluate(trained, "tiny", "--set", "world.randomisation.delay_steps=[1,1]").exit_code == 0


def test_evaluate_beside_a_wall_has_the_goals_of_such_a_world(trained):
    result = evaluate(trained, "tiny", "--set", "world.fixture=wall", "--json")
    assert result.exit_code == 0, result.output
    assert json.loads(result.stdout)["idle"]["goals"] == "table"


def test_evaluate_for_people(trained):
    result = evaluate(trained, "tiny@1", "--goals", "mixed")
    assert result.exit_code == 0
    head, *rows = result.stdout.splitlines()
    assert head.startswith("8 random goals (mixed), 2 steps")
    assert "0.4 cm" in head  # this run's own success distance
    assert [row.split()[0] for row in rows] == ["tiny@1", "idle"]
    assert all("%" in row and "mean distance" in row for row in rows)


def test_coverage(trained, tmp_path):
    picture = tmp_path / "sub" / "a-picture-with-quite-a-long-name-so-that-it-does-not-fit-a-line.png"
    common = ("coverage", "tiny", "--registry", trained.registry, "--skills", 3, "--steps", 4)
    result = tandem(*common, "--out", picture, "--json")
    assert result.exit_code == 0, result.output
    tree = json.loads(result.stdout)
    assert tree["picture"] == str(picture)
    assert list(tree["share_of_table_cells_visited"]) == ["tiny@1", "random policy"]
    assert all(0.0 <= share <= 1.0 for share in tree["share_of_table_cells_visited"].values())
    assert picture.stat().st_size > 10_000
    text = tandem(*common, "--out", picture).stdout
    assert text.count("of the workspace's table cells visited\n") == 2
    assert f"picture: {picture}\n" in text  # on one line, to be copied


@pytest.fixture
def filmed(monkeypatch):
    """(number of takes or episodes, file) of each video, none of which is drawn."""
    asked = []

    def write_video(takes, world, path, options):
        asked.append((len(takes), path))

    def write_episode_video(episodes, world, path, options):
        asked.append((episodes.goal.shape, path))

    monkeypatch.setattr("service.media.video.write_video", write_video)
    monkeypatch.setattr("service.media.video.write_episode_video", write_episode_video)
    return asked


def test_render_films_rounds_of_a_run_and_episodes_of_published_primitives(trained, filmed, tmp_path):
    out = tmp_path / "a-video-[b]-with-quite-a-long-name-so-that-it-does-not-fit-a-line.mp4"
    result = tandem("render", trained.run, "--episodes", 2, "--out", out)
    assert result.exit_code == 0, result.output
    assert result.stdout == f"video: {out}\n"  # on one line, to be copied
    tandem("render", "tiny@latest", "--episodes", 3, "--registry", trained.registry, "--out", out)
    assert filmed == [(2, out), ((3, 3), out)]


def test_render_films_goals_that_are_typed(trained, monkeypatch, tmp_path):
    shown = []
    monkeypatch.setattr("service.media.video.write_episode_video", lambda *arguments: shown.append(arguments))
    goals = ("--goals", "0.02,0,0.2; 0,-0.05,0.035")
    look = ("--size", "640x360", "--camera", "side,distance=2", "--speed", 0.5)
    result = tandem("render", trained.run, *goals, *look, "--out", tmp_path / "a.gif")
    assert result.exit_code == 0, result.output
    ((episodes, _, path, options),) = shown
    assert episodes.goal.tolist() == [[0.02, 0.0, 0.2], [0.0, -0.05, 0.035]]
    assert (path, options.width, options.height, options.speed) == (tmp_path / "a.gif", 640, 360, 0.5)
    assert (options.view.azimuth_deg, options.view.distance_m) == (90.0, 2.0)


@pytest.mark.parametrize(
    ("arguments", "part"),
    [
        (["--goals", "lift"], "--goals 'lift': write one of table, air, mixed, volume, one, or points"),
        (["--goals", "0.1,nan,0.2"], "or points with ; between, each x,y,z in metres"),
        (["--goals", "0.1,0,0.2;0.9,0,0.1"], "0.900, 0.000, 0.100 is outside of the workspace"),
        (["--size", "641x360"], "--size '641x360': write WIDTHxHEIGHT, even numbers"),
        (["--camera", "moon"], "camera 'moon': there is none"),
        (["--speed", "0"], "'--speed': "),
        (["--out", "film.avi"], "film.avi: a film ends in .mp4 or .gif"),
    ],
)
def test_a_film_that_cannot_be_made(arguments, part, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert_refused(tandem("render", *arguments), part)
    assert list(tmp_path.iterdir()) == []


def test_a_goal_of_a_film_is_in_no_fixture():
    world = WorldConfig(fixtures=[{"shape": "box", "size_m": (0.1, 0.1, 0.1), "position_m": (0.05, 0.05)}])
    assert parse_goals("0.05,0.05,0.2", world).tolist() == [[0.05, 0.05, 0.2]]
    with pytest.raises(TandemError, match=r"--goals: at 0\.050, 0\.050, 0\.050 an object would be inside a fixture"):
        parse_goals("0.05,0.05,0.2; 0.05,0.05,0.05", world)


# --- mistakes --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "parts"),
    [
        (["--set", "game.num_worlds=0"], ["game.num_worlds", "0"]),
        (["--set", "world.object=bunny"], ["world.object", "bunny"]),
        (["--set", "name=No Name"], ["name", "No Name"]),
        (["--set", "seed"], ["'seed'", "KEY=VALUE"]),
        (["--set", "learner.device=cuda"], ["learner.device", "cuda", "cpu"]),
        (["--config", "none.yaml"], ["none.yaml"]),
        (["--config", "."], ["."]),
        (["--resume", "--config", "tiny.yaml"], ["--resume needs --run-dir"]),
        (["--resume", "--run-dir", "none"], ["no run in none"]),
        (["--registry", BUNDLED, "--run-dir", "run"], ["cannot write", BUNDLED, "only read"]),
        (["--resume", "--run-dir", "RUN", "--set", "seed=3"], ["seed = 3, but the run has 0", "only run.*"]),
        (["--resume", "--run-dir", "RUN", "--config", "OTHER"], ["seed = 3, but the run has 0", "without --resume"]),
        (["--run-dir", "OTHER"], ["other.yaml is no directory"]),
    ],
)
def test_mistakes_of_pretrain(trained, monkeypatch, tmp_path, arguments, parts):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    names = {"RUN": trained.run, "OTHER": write_yaml(trained.home / "other.yaml", TREE | {"seed": 3})}
    assert_refused(tandem("pretrain", *(names.get(each, each) for each in arguments)), *parts)
    assert list(tmp_path.iterdir()) == []


def test_a_resume_without_a_checkpoint(tmp_path):
    directory = RunDirectory(tmp_path)
    directory.start(tiny_config())
    directory.close()
    for file in (tmp_path / "checkpoints").iterdir():
        file.unlink()
    assert_refused(tandem("pretrain", "--resume", "--run-dir", tmp_path), "no checkpoint in", tmp_path)


@pytest.mark.parametrize(
    ("arguments", "parts"),
    [
        (["evaluate", "no/where"], ["no/where", "no such directory of a run"]),
        (["coverage", "tiny", "--skills", "2", "--steps", "1", "--out", "file/x.png"], ["file/x.png"]),
        (["coverage", "tiny", "--out", "x.txt"], ["--out x.txt", "ends in .png"]),
    ],
)
def test_mistakes_of_the_others(trained, monkeypatch, tmp_path, arguments, parts):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").write_text("")
    assert_refused(tandem(*arguments, TANDEM_REGISTRY=str(trained.registry)), *parts)


def test_a_full_disk_during_a_checkpoint(tmp_path, full_disk):
    config = write_yaml(tmp_path / "tiny.yaml")
    full_disk("fsync")
    result = tandem("pretrain", "--config", config, "--run-dir", tmp_path / "run", "--registry", tmp_path / "registry")
    assert_refused(result, "checkpoint-", "No space left on device")


def test_a_disk_that_is_full_to_the_end(tmp_path):
    """It is no mistake of what was typed, and what came before it is there."""
    places = ("--config", write_yaml(tmp_path / "tiny.yaml"), "--run-dir", tmp_path / "run")
    with no_room_above(200_000):
        result = tandem("pretrain", "-q", *places, "--registry", tmp_path / "none")
    assert result.exit_code == 1
    assert_one_line(result.stderr, "error: ", "File too large", "saved is iteration 2", "--resume")
    assert not (tmp_path / "none").exists()


def test_a_method_makes_a_run_of_skills_under_its_own_name(asked):
    tandem("pretrain", "--method", "dads", "--set", "seed=3")
    tandem("pretrain", "--method", "lsd")
    tandem("pretrain", "--method", "dads", "--set", "skills.hidden_sizes=[32]")
    first = asked[0][0]
    assert (first.skills.method, first.name, first.seed, asked[0][1].name) == (
        *("dads", "panda-cube-dads", 3, "panda-cube-dads"),
    )
    assert [config.skills.hidden_sizes for config, *_ in asked] == [(64, 64), (256, 256), (32,)]
    assert_refused(tandem("pretrain", "--method", "ppo"), "method = 'ppo'", "lsd, dads, diayn, metra")
