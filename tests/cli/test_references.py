"""Every command takes every reference, or says in a line why it means nothing there."""

import json

import pytest

from service.config.skills import SkillsConfig
from service.registry.publishing import publish
from service.registry.registry import Registry
from tests.cli.typed import assert_refused, tandem
from tests.export.policies import publish_bob, write_training
from tests.methods import skill_sets
from tests.status.conftest import serve

SMALL = ("--episodes", "2", "--json")


@pytest.fixture
def home(tmp_path, monkeypatch):
    """A directory with a registry of primitives and skills, and a training."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("TANDEM_REGISTRY", raising=False)
    registry = Registry(tmp_path / "registry")
    write_training(tmp_path / "training", publish_bob(registry), "ours", "wall")
    publish(registry, skill_sets.CONFIG.model_copy(update={"name": "skills"}), skill_sets.parameters(), {})
    (tmp_path / "runs").mkdir()
    return tmp_path


def test_a_policy_of_a_task_is_evaluated_on_its_task(home):
    found = tandem("evaluate", "training", "--steps", 2, *SMALL)
    assert found.exit_code == 0, found.output
    rows = json.loads(found.stdout)
    assert list(rows) == ["task", "training", "made@1, Bob alone", "idle"]
    assert (rows["task"], rows["training"]["goals"]) == ("wall", "table")
    moved = tandem("evaluate", "training", "--primitives", "made@1", "--steps", 2, *SMALL)
    assert moved.stdout == found.stdout


def test_primitives_are_tried_on_a_task(home):
    found = tandem("evaluate", "made", "--task", "wall", *SMALL)
    assert found.exit_code == 0, found.output
    assert list(json.loads(found.stdout)) == ["task", "made@1", "idle"]


def test_skills_are_taken_as_primitives_are(home, monkeypatch):
    shown = []
    monkeypatch.setattr("service.media.video.write_episode_video", lambda *arguments: shown.append(arguments))
    settings = skill_sets.CONFIG.skills.model_dump(exclude={"prior", "zero_shot"}) | {"method": "dads"}
    dads = skill_sets.CONFIG.model_copy(update={"name": "dads", "skills": SkillsConfig(**settings)})
    publish(Registry(home / "registry"), dads, skill_sets.parameters(), {})
    found = tandem("coverage", "dads", "--skills", 3, "--steps", 4, "--json")
    assert json.loads(found.stdout)["share_of_table_cells_visited"].keys() == {"dads@1", "random policy"}
    assert (home / "coverage.png").stat().st_size > 10_000
    rows = json.loads(
        tandem("evaluate", "skills", "--episodes", 5, "--steps", 3, "--json").stdout
    )  # the one towards the goal acts
    assert rows["skills@1"]["mean_distance_m"] != rows["idle"]["mean_distance_m"]
    assert_refused(tandem("evaluate", "dads", *SMALL), "error: dads@1 is a set of skills of dads, which no goal leads")
    tandem("render", "dads", "--episodes", 2, "--out", "skills.mp4")
    ((episodes, _, path, _),) = shown
    assert (episodes.states.shape[:2], episodes.goal, path.name) == ((51, 2), None, "skills.mp4")


def test_a_registry_may_be_a_url(home, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(home / "cache"))
    with serve(home) as server:
        monkeypatch.chdir(home / "runs")  # where no registry is
        monkeypatch.setenv("TANDEM_REGISTRY", server.url)
        for arguments in (
            ("evaluate", "made", "--steps", 2, *SMALL),
            ("coverage", "skills", "--steps", 2, "--skills", 2, "--json"),
            ("evaluate", home / "training", *SMALL),
        ):
            done = tandem(*arguments)
            assert done.exit_code == 0, done.output
        refused = tandem("pretrain", "--from", "made", "--config", "panda-cube")
        assert_refused(refused, f"{server.url} is read only: publish in a directory")
        refused = tandem("pretrain", "--from", "skills", "--no-publish", "--config", "panda-cube")
        assert_refused(refused, "skills@1 is a set of skills of lsd; --from needs primitives")


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("coverage", "training"), "tandem coverage needs primitives or skills: name made@1, which it"),
        (("dataset", "skills", "--out", "d"), "skills@1 is a set of skills of lsd; tandem dataset needs primitives"),
        (("robot", "run", "--robot", "mujoco", "--policy", "skills"), "set of skills of lsd; tandem robot"),
        (
            ("pretrain", "--from", "training"),
            "is a policy of the task wall; --from needs primitives: name made",
        ),
        (("train", "wall", "--primitives", "training"), "the method ours needs primitives: name"),
        (("publish", "made@1", "--name", "x"), "no run in made@1"),
        (("export", "runs", "--format", "numpy", "--out", "o"), "no run in runs"),
    ],
)
def test_a_kind_that_means_nothing_there(home, arguments, said):
    assert_refused(tandem(*arguments), said)
