"""Skill-discovery runs: records, exact resume, publishing, and what is refused."""

import json

import numpy as np
import pytest

import service
from service.base.errors import TandemError
from service.base.jsonl import read_jsonl
from service.cluster.ray_connection import ClusterOptions
from service.cluster.ray_runtime import RayRuntime
from service.config import parse_config
from service.config.skills import SkillsConfig
from service.policies.frozen_skills import FrozenSkills, SkillPlayer
from service.registry.registry import Registry
from service.runs.train import open_run, train
from service.store.checkpoints import CheckpointStore
from service.store.run_directory import RunDirectory
from tests.runs.runs import run_on


def small_config(method="lsd", **run):
    sac = {"num_worlds": 4, "gradient_steps": 2, "batch_size": 16, "learning_starts": 100, "hidden_sizes": [8]}
    skills = {"method": method, "episode_steps": 10, "hidden_sizes": [8], "batch_size": 8, "sac": sac}
    tree = {
        "name": f"cube-{method}",
        "method": "skills",
        "skills": skills,
        "world": {"physics_step_s": 0.005, "num_substeps": 8},
        "run": {"total_env_steps": 400, "checkpoint_interval": 4, "evaluation_interval": 5, "num_threads": 1, **run},
    }
    return parse_config(tree, where="a test")


def timeless(path):
    rows = read_jsonl(path / "metrics.jsonl")
    return [{key: value for key, value in row.items() if not key.startswith("time/")} for row in rows]


def play(path, config, *, resume=False, stop_after=None):
    run = open_run(config, directory := RunDirectory(path), resume=resume)

    def stop(metrics):
        if metrics["iteration"] == stop_after:
            run.request_stop()

    result = run_on(run, stop)
    run.close()
    directory.close()
    return result


def test_a_resumed_run_is_the_uninterrupted_one(tmp_path):
    config = small_config("metra")
    assert play(tmp_path / "whole", config).reason == "finished"
    assert play(tmp_path / "cut", config, stop_after=5).reason == "interrupted"
    np.random.seed(3)
    assert play(tmp_path / "cut", config, resume=True).reason == "finished"
    assert timeless(tmp_path / "whole") == timeless(tmp_path / "cut")
    one, other = (CheckpointStore(tmp_path / name / "checkpoints", 1).load_latest() for name in ("whole", "cut"))
    assert one.arrays.keys() == other.arrays.keys()
    assert all(np.array_equal(array, other.arrays[name]) for name, array in one.arrays.items())
    assert one.meta["state"] == other.meta["state"]


def test_its_records(published):
    rows = read_jsonl(published / "run" / "metrics.jsonl")
    assert [row["env_steps"] for row in rows] == list(range(40, 401, 40))
    assert [row["iteration"] for row in rows if "evaluation/coverage" in row] == [5, 10]
    assert all(np.isfinite(list(row.values())).all() for row in rows)
    assert set(rows[-1]) == {
        "iteration", "env_steps", "time/wall_s", "time/env_steps_per_s", "evaluation/coverage",
        "learner/critic_loss", "learner/actor_loss", "learner/entropy_coefficient", "learner/entropy",
        "learner/representation_loss",
        "skills/moved_fraction", "skills/outside_fraction", "skills/lifted_fraction", "skills/raised_fraction",
        "skills/distance_m", "skills/num_cells_seen",
    }  # fmt: skip


def test_what_the_object_did_is_counted(tmp_path):
    run = open_run(small_config(), RunDirectory(tmp_path))
    start, air, low = (0, 0, 0.025), (0.0, 0.06, 0.1), (0.0, 0.06, 0.07)
    ways = [
        (start, low, (0.0, 0.04, 0.025)),
        (start, air, air),
        (start, air, (0.0, 0.06, 0.025)),
        (start, air, (1, 0, -3)),
    ]
    run.method._worlds.finished += [np.float32(way) for way in ways]
    found = run.method._episodes()
    assert found["skills/moved_fraction"] == 0.5  # and is still there
    assert found["skills/lifted_fraction"] == 0.25
    assert found["skills/raised_fraction"] == 0.75
    assert found["skills/outside_fraction"] == 0.25
    assert found["skills/num_cells_seen"] == 2.0
    distance = [0.04, np.hypot(0.06, 0.075), 0.06]
    assert found["skills/distance_m"] == pytest.approx(np.mean(distance), rel=1e-5)
    grid = run.method.grid()
    assert sorted(cell.num_tries for cell in grid.cells) == [1, 1]
    assert run.method._worlds.finished == []
    run.close()


@pytest.fixture(scope="module")
def published(tmp_path_factory):
    """A run that ended and published, and its registry."""
    path = tmp_path_factory.mktemp("skills")
    run = RunDirectory(path / "run")
    drawn = []
    with pytest.MonkeyPatch.context() as patch:  # a video takes seconds, and OpenGL
        patch.setattr(
            "service.media.video.write_episode_video",
            lambda episodes, world, path, options: drawn.append(episodes) or path,
        )
        done = train(small_config(), run, path / "registry", on_iteration=lambda metrics: None)
    assert str(done.version) == "cube-lsd@1"
    assert done.files == {
        "curves": run.path / "curves.png", "coverage": run.path / "coverage.png", "video": run.path / "skills.mp4"
    }  # fmt: skip
    assert drawn[0].states.shape[:2] == (11, 6)
    assert 0.0 <= done.metrics["coverage"] <= 1.0
    return path


def test_published_skills_are_those_of_the_run(published):
    loaded = service.load("cube-lsd@1", published / "registry")
    own = service.load(str(published / "run"))
    assert loaded.manifest.spaces["kind"] == "skills"
    assert loaded.skills.size == own.skills.size == loaded.manifest.spaces["skill"] == 4
    assert loaded.skills.method == "lsd"
    rng = np.random.default_rng(0)
    positions = rng.uniform(-0.1, 0.3, (5, 11)).astype(np.float32)
    skill, goal = loaded.skills.draw(5, rng), np.float32([[0.1, 0.0, 0.2]] * 5)
    actions = loaded.skills.actions(positions, positions, skill)
    assert actions.shape == (5, 4)
    assert abs(actions).max() <= 1.0
    np.testing.assert_array_equal(actions, own.skills.actions(positions, positions, skill))
    towards = loaded.skills.towards(positions, goal)
    np.testing.assert_allclose(np.linalg.norm(towards, axis=1), 1.8799712, rtol=1e-5)  # the mean of |N(0, I_4)|
    status = json.loads((published / "run" / "status.json").read_text())
    assert status["state"] == "finished"
    assert status["published"] == "cube-lsd@1"


def test_a_player_sees_how_things_moved(published):
    skills = service.load("cube-lsd", published / "registry").skills
    rng = np.random.default_rng(0)
    skill, first, second = skills.draw(3, rng), *rng.uniform(0.0, 0.1, (2, 3, 11)).astype(np.float32)
    player = SkillPlayer(skills, skill)
    np.testing.assert_array_equal(player(first), skills.actions(first, first, skill))
    np.testing.assert_array_equal(player(second), skills.actions(first, second, skill))
    assert not np.array_equal(skills.actions(first, second, skill), skills.actions(second, second, skill))


class TestBadInput:
    def refused(self, words, call, *args, **named):
        with pytest.raises(TandemError, match=words) as caught:
            call(*args, **named)
        assert "\n" not in str(caught.value)

    def test_skills_where_primitives_are_expected(self, published):
        words = r"is a set of skills of lsd; tandem x needs primitives$"
        for reference in ("cube-lsd@1", str(published / "run")):
            loaded = service.load(reference, published / "registry")
            self.refused(words, loaded.expect, "primitives", by="tandem x")

    def test_zero_shot_by_dads(self, published):
        parameters = Registry(published / "registry").load("cube-lsd@1")[1]
        dads = FrozenSkills(parameters, SkillsConfig(method="dads"))
        self.refused("skills of dads lead to no goal", dads.towards, np.zeros((1, 11), np.float32), np.zeros((1, 3)))

    def test_parameters_of_something_else(self):
        self.refused("not of skills", FrozenSkills, {"gate.0.weight": np.zeros((2, 2), np.float32)}, SkillsConfig())

    def test_on_a_cluster(self, tmp_path):
        self.refused(
            "method = skills: it runs in one process; use --runtime local", train, small_config(),
            RunDirectory(tmp_path / "run"), tmp_path, on_iteration=lambda metrics: None,
            runtime=RayRuntime(ClusterOptions()),
        )  # fmt: skip
        assert not (tmp_path / "run").exists()
