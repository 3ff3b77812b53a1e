"""A user's source of goals: what it is told, what becomes of its goals, and what is refused."""

import numpy as np
import pytest

from service.base.errors import ConfigError, TandemError
from service.config import load_config, parse_config
from service.generator.generator import TaskGenerator
from service.generator.sources import CheckedSource
from service.generator.validity import Verdict
from tests.generator.test_generator import FREE, ONE_GAME, choose, everywhere, only_starts, record
from tests.runs.runs import TREE, assert_one_line, play

CODE = """
import numpy as np
from service.generator.sources import GoalSource

class Corner(GoalSource):
    def goals(self, known, rng):
        goal = rng.uniform([0.05, 0.05, 0.025], [0.3, 0.1, 0.025], (400, 1, 3))
        return goal[known.near(goal[:, 0])]

    def weights(self, known, goal, start, learnability):
        assert goal.shape == start.shape == (*learnability.shape, 1, 3)
        return (goal[:, 0, 0] > 0.08) * (learnability > 0.0)
"""
RUNS_OUT = """
from service.generator.sources import GoalSource

class Corner(GoalSource):
    num_calls = 0

    def goals(self, known, rng):
        Corner.num_calls += 1
        return known.random(rng, 0 if Corner.num_calls > 9 else 400)
"""
SETTINGS = ("generator.goal_source=corner.py", "generator.replay_invalid=true", "generator.replay_from_reset=true")


@pytest.fixture
def file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "corner.py").write_text(CODE)
    return tmp_path / "corner.py"


def test_goals_are_its_own_and_in_the_workspace(file):
    config = load_config(None, SETTINGS).begin("registry", None)
    assert config.code == {"corner.py": CODE}
    file.unlink()
    generator = TaskGenerator(config, FREE)
    outside = [Verdict.OUTSIDE] * 200
    assert not choose(generator, outside).replayed.any()  # nothing was reached yet, so it has none
    everywhere(only_starts(ONE_GAME), generator)
    choice = choose(generator, outside)
    assert choice.replayed.all()
    assert 0.3 < choice.from_reset.mean() < 0.7
    x, y, z = choice.goal.T
    assert 0.08 < x.min() < x.max() <= 0.125  # where weights are, and no further than the workspace
    assert 0.05 <= y.min() < y.max() <= 0.1
    assert (z == 0.025).all()
    same = choose(generator, outside)
    np.testing.assert_array_equal(choice.goal, same.goal)
    record(generator, only_starts(ONE_GAME))


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("return goal[known", "return goal[:, :, :2][known", "corner.py: Corner.goals gave float64 of shape ("),
        (
            "[0.05, 0.05, 0.025], [0.3",
            "[1.05, 0.05, 0.025], [1.3",
            "while nothing is known, as (1.",
        ),
        ("goal[:, 0])]", "goal[:, None])]", "corner.py: known.near: goal has shape ("),
        ("known.near(", "known.far(", "corner.py:8: AttributeError: "),
        ("(learnability > 0.0)", "np.nan", "Corner.weights gave nan at [0] of shape ("),
        ("(learnability > 0.0)", "1e308", "Corner.weights gave up to 1e+308, whose sum is too large; give smaller"),
        ("(learnability > 0.0)", "-learnability", "Corner.weights gave -0.25 at [0]; give weights of 0 or more"),
        ("(learnability > 0.0)", "learnability[:, None]", "Corner.weights gave float64 of shape ("),
        (
            "def goals",
            "def gaols",
            "corner.py: Corner.gaols is no member of GoalSource; did you mean 'goals'? The name of a helper",
        ),
        ("Corner(GoalSource)", "Corner", "corner.py: it has to define one class that derives from GoalSource, and has"),
    ],
)
def test_what_is_wrong_is_said_before_anything_is_learned(file, old, new, said):
    assert old in CODE
    file.write_text(CODE.replace(old, new))
    with pytest.raises(TandemError) as error:
        load_config(None, SETTINGS).begin("registry", None)
    assert_one_line(error.value, said)


def test_it_cannot_change_the_goals_that_are_played(file):
    file.write_text(CODE.replace("        assert goal.shape", "        goal += 1.0\n        assert goal.shape"))
    with pytest.raises(TandemError) as error:
        load_config(None, SETTINGS).begin("registry", None)
    assert_one_line(error.value, "ValueError", "read-only")


def test_goals_as_random_gives_them(file):
    file.write_text(CODE.replace("return goal[known.near(goal[:, 0])]", "return known.random(rng, 50)"))
    config = load_config(None, SETTINGS).begin("registry", None)
    assert CheckedSource(config, 0.0, 0.0, lambda goal: goal[:, 0] > 0).goals(np.random.default_rng(0)).shape == (50, 3)


def test_no_goal_is_inside_a_fixture(file):
    block = {"shape": "box", "size_m": [0.04, 0.04, 0.2], "position_m": [0.12, 0.075]}
    everywhere = CODE.replace("[known.near(goal[:, 0])]", "")
    file.write_text(everywhere)
    config = load_config(None, SETTINGS).begin("registry", None)
    kept = [
        CheckedSource(each, 0.0, 0.0, lambda goal: goal[:, 0] > 0).goals(np.random.default_rng(0))
        for each in (config, parse_config(config.model_dump() | {"world": {"fixtures": [block]}}, where="a test"))
    ]
    assert 0 < len(kept[1]) < len(kept[0])
    assert kept[0][:, 0].max() > 0.12 > 0.08 > kept[1][:, 0].max()  # 2 cm of the block, 2.5 cm of the cube


def test_a_run_that_gets_no_goal_any_more_ends(file, tmp_path, monkeypatch):
    monkeypatch.setattr("service.runs.run.MAX_IDLE", 5)
    file.write_text(RUNS_OUT)
    tree = {
        "game": TREE["game"] | {"alice_plays": False},
        "generator": {"goal_source": "corner.py", "replay_invalid": True},
    }
    config = parse_config(TREE | tree | {"run": TREE["run"] | {"total_env_steps": 10**9}}, where="a test")
    with pytest.raises(ConfigError) as error:
        play(tmp_path / "run", config.begin("registry", None))
    assert_one_line(error.value, "5 iterations made no env steps: generator.goal_source gave no goal that Bob can ")


@pytest.mark.parametrize("kind", ["tabel", "one"])
def test_random_goals_are_of_a_kind_that_there_is(file, kind):
    file.write_text(CODE.replace("goal = rng.uniform", f"known.random(rng, 4, '{kind}'); goal = rng.uniform"))
    with pytest.raises(TandemError) as error:
        load_config(None, SETTINGS).begin("registry", None)
    assert_one_line(error.value, f"goals = '{kind}'")
