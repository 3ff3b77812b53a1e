"""Commands that take skills as they take primitives."""

import json

import pytest
from typer.testing import CliRunner

from service.cli.main import app
from service.config.skills import SkillsConfig
from service.registry.publishing import publish
from service.registry.registry import Registry
from tests.methods.skill_sets import CONFIG, SIZE, parameters


@pytest.fixture
def registry(tmp_path):
    registry = Registry(tmp_path / "registry")
    for method in ("lsd", "dads"):
        config = CONFIG.model_copy(update={"name": method, "skills": SkillsConfig(method=method, size=SIZE)})
        publish(registry, config, parameters(), {"env_steps": 100.0})
    return registry.root


def tandem(*arguments):
    return CliRunner().invoke(app, [str(each) for each in arguments])


def test_coverage_of_skills(registry, tmp_path):
    picture = tmp_path / "skills.png"
    common = ("coverage", "dads@1", "--registry", registry, "--skills", 3, "--steps", 4)
    found = tandem(*common, "--out", picture, "--json")
    assert found.exit_code == 0, found.output
    assert json.loads(found.stdout)["share_of_table_cells_visited"].keys() == {"dads@1", "random policy"}
    assert picture.stat().st_size > 10_000


def test_skills_are_evaluated_by_the_one_towards_the_goal(registry):
    common = ("evaluate", "--registry", registry, "--episodes", 5, "--steps", 3, "--json", "--primitives")
    found = tandem(*common, "lsd@1")
    assert found.exit_code == 0, found.output
    rows = json.loads(found.stdout)
    assert rows["lsd@1"]["mean_distance_m"] != rows["idle"]["mean_distance_m"]
    refused = tandem(*common, "dads@1")
    assert refused.exit_code == 2
    assert refused.stderr.startswith("error: dads@1 is a set of skills of dads, which no goal leads; tandem evaluate")


def test_render_shows_random_skills(registry, tmp_path, monkeypatch):
    shown = []
    monkeypatch.setattr(
        "service.media.video.write_episode_video", lambda episodes, world, path, options: shown.append((episodes, path))
    )
    common = ("render", "dads@1", "--registry", registry, "--episodes", 2)
    found = tandem(*common, "--out", tmp_path / "skills.mp4")
    assert found.exit_code == 0, found.output
    ((episodes, path),) = shown
    assert (episodes.states.shape[:2], episodes.goal, path) == ((51, 2), None, tmp_path / "skills.mp4")
