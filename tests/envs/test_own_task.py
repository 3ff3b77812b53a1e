"""A task of a user's: what its functions see, what they say, what is remembered, and what is refused."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from service.actors.evaluation import IdlePolicy, evaluate
from service.base.errors import TandemError
from service.base.user_code import CodeError
from service.config import WorldConfig
from service.envs.batch import WorldBatch
from service.envs.gym.tabletop import TabletopEnv
from service.envs.gym.vector import TabletopVectorEnv
from service.envs.rules import Rules
from service.envs.sampling import check_goals
from service.envs.task import Task, View, num_in_rows
from service.envs.tasks import PAPERS, TASKS, find_task
from tests.runs.runs import assert_one_line

WORLD = WorldConfig(physics_step_s=0.005, num_substeps=8)
CLOSE, OPEN = ([0.0, 0.0, 0.0, grip] for grip in (-1.0, 1.0))
GOAL = np.array([[0.0, 0.0, 0.2], [0.1, 0.0, 0.025]])


@pytest.fixture
def worlds():
    with WorldBatch(WORLD, 2, num_threads=1) as batch:
        batch.reset(np.random.default_rng(0))
        yield batch


def counting(s):
    return s.memory + 1


def test_what_a_view_has(worlds):
    worlds.step(np.array([CLOSE, OPEN], dtype=np.float32))
    worlds.states[1, worlds.layout["object_velocity"]] = [0.1, 0.2, 0.3]
    rules = Rules(Task("Mine", remember=counting, memory_size=2), worlds)
    rules.advance(GOAL)
    view = rules.view(GOAL)
    np.testing.assert_array_equal(view.objects[:, 0].place, worlds.object_position)
    np.testing.assert_allclose(view.objects[1, 0].velocity, [0.1, 0.2, 0.3])
    np.testing.assert_array_equal(view.gripper, worlds.ee_position)
    assert view.fingers[0] < 0.06 < 0.075 < view.fingers[1]
    assert view.contacts.shape == (2, 1, 2)
    np.testing.assert_array_equal(view.goal[:, 0], GOAL)
    np.testing.assert_array_equal(view.elapsed, [1, 1])
    np.testing.assert_array_equal(view.memory, [[1.0, 1.0], [1.0, 1.0]])


def test_what_a_function_sees_is_not_written_to(worlds):
    """Or it would move the object of the world that is played."""

    def lift(s):
        s.objects.place[..., 2] += 0.1

    before = worlds.states.copy()
    with pytest.raises(CodeError, match=r"ValueError: .*read-only"):
        Rules(Task("Mine", success=lift), worlds).solved(GOAL)
    np.testing.assert_array_equal(worlds.states, before)


def test_the_world_of_a_task():
    plain = WorldConfig()
    described = {"object": {"shape": "cylinder", "size_m": (0.04, 0.06)}}
    task = Task("Can", world={**described, "workspace": {"height_m": 0.4}})
    world = task.world_from(plain)
    assert world.object != plain.object
    assert world.workspace == plain.workspace.model_copy(update={"height_m": 0.4})
    assert json.loads(json.dumps(task.data()))["world"]["object"]["size_m"] == [0.04, 0.06]
    with pytest.raises(ValueError, match=r"task Can: world = \[1\]: give a mapping of settings"):
        Task("Can", world=[1])


def test_rows_hold_a_view_but_for_goal_and_memory(worlds):
    rules = Rules(Task("Mine"), worlds)
    rules.advance(GOAL)
    before = rules.view(GOAL)
    rows = before.rows()
    assert rows.shape == (2, num_in_rows(1))
    after = View.of_rows(rows, GOAL[::-1, None].astype(np.float32))
    for name in ("gripper", "fingers", "contacts", "elapsed"):
        np.testing.assert_allclose(getattr(after, name), getattr(before, name), rtol=1e-6)
    np.testing.assert_allclose(after.objects.place, before.objects.place, rtol=1e-6)
    np.testing.assert_allclose(after.objects.velocity, before.objects.velocity, rtol=1e-6)
    np.testing.assert_allclose(after.goal[:, 0], GOAL[::-1], rtol=1e-6)
    uses = (lambda m: m[:, 0], lambda m: m + 1, lambda m: np.ones(2) < m, lambda m: m.any(), np.asarray, len, bool)
    for use in uses:
        with pytest.raises(LookupError, match="memory is not known where a reward is computed again"):
            use(after.memory)


def held(num):
    """Solved once the fingers were less than 6 cm apart for ``num`` steps in a row."""
    return Task(
        "Held",
        goals="table",
        remember=lambda s: np.where(s.fingers[:, None] < 0.06, s.memory + 1, 0),
        memory_size=1,
        success=lambda s: s.memory[:, 0] >= num,
        reward=lambda s: s.elapsed,
        episode_steps=4,
    )


def test_an_environment_of_a_task_that_remembers():
    env = TabletopVectorEnv(2, WORLD, task=held(3), num_threads=1)
    env.reset(seed=0)
    solved, paid = [], []
    for first in (CLOSE, CLOSE, OPEN, CLOSE, CLOSE, CLOSE, CLOSE):
        _, reward, _, _, info = env.step(np.array([first, CLOSE], dtype=np.float32))
        final = info.get("final_info", info)
        solved.append(final["is_success"].tolist())
        paid.append(reward.tolist())
        if len(paid) == 5:
            saved = env.state()
    # one opens them in the third step, and both forget when an episode ends after four
    assert [each[1] for each in solved] == [False, False, True, True, False, False, True]
    assert [each[0] for each in solved] == [False] * 6 + [True]
    assert paid == [[float(step)] * 2 for step in (1, 2, 3, 4, 1, 2, 3)]
    env.restore(saved)
    again = [env.step(np.array([CLOSE, CLOSE], dtype=np.float32))[4]["is_success"].tolist() for _ in range(2)]
    assert again == solved[5:]
    env.close()


def test_one_world_counts_as_many_do():
    env = TabletopEnv(WORLD, task=held(2))
    env.reset(seed=0)
    steps = [env.step(np.array(CLOSE, dtype=np.float32)) for _ in range(3)]
    assert [step[4]["is_success"] for step in steps] == [False, True, True]
    assert [step[1] for step in steps] == [1.0, 2.0, 3.0]
    env.close()


def test_evaluate_asks_the_task():
    class Closes(IdlePolicy):
        def act_deterministic(self, observation):
            return np.tile(np.float32(CLOSE), (len(observation), 1))

    task = held(4)
    numbers = {"num_episodes": 3, "num_steps": 4, "success_distance_m": 0.05, "seed": 0, "num_threads": 1}
    told = []
    found = evaluate(Closes(), WORLD, task, **numbers, observe=lambda _, __, solved: told.append(solved.all()))
    assert (found.success_last, told) == (1.0, [False] * 4 + [True])
    assert evaluate(Closes(), WORLD, task, **{**numbers, "num_steps": 3}).success_ever == 0.0


def test_goals_are_drawn_by_the_task_and_again_where_they_are_out_of_reach():
    def beside(s, rng):
        return s.objects.place + np.where(
            rng.random((len(s.objects.place), 1, 1)) < 0.5, [0.0, 0.05, 0.0], [0.0, 9.0, 0.0]
        )

    task = Task("Beside", goals=beside)
    env = TabletopVectorEnv(8, WORLD, task=task, num_threads=1)
    observation, _ = env.reset(seed=0)
    way = observation["desired_goal"] - observation["achieved_goal"]
    np.testing.assert_allclose(way, np.tile([0.0, 0.05, 0.0], (8, 1)), atol=1e-6)
    env.close()
    never = TabletopEnv(WORLD, task=replace(task, goals=lambda s, rng: s.objects.place + 9.0))
    with pytest.raises(TandemError, match=r"test_own_task.py:\d+: goals gave no place that is within reach"):
        never.reset(seed=0)
    never.close()


def test_reward_of_places_alone():
    """What hindsight of other programs asks; a task that needs more says so."""
    near = Task("Near", success=lambda s: np.abs(s.objects[:, 0].place - s.goal[:, 0]).max(axis=-1) < 0.1)
    env = TabletopVectorEnv(2, WORLD, task=near, num_threads=1)
    places = np.array([[0.0, 0.0, 0.09], [0.0, 0.0, 0.11]])
    np.testing.assert_array_equal(env.compute_reward(places, np.zeros((2, 3)), {}), [1.0, 0.0])
    np.testing.assert_array_equal(env.compute_reward(places[:, None], np.zeros(3), {}), [[1.0], [0.0]])
    env.close()
    env = TabletopVectorEnv(2, WORLD, task=held(3), num_threads=1)
    with pytest.raises(CodeError, match=r"test_own_task.py:\d+: "):
        env.compute_reward(places, np.zeros((2, 3)), {})
    env.close()


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"success": lambda s: s.fingers}, "success gave float64 of shape (2,); give bool of shape (2,)"),
        ({"success": lambda s: True}, "success gave bool of shape (); give bool of shape (2,)"),
        ({"success": lambda s: s.goal[:, 1, 0] > 0}, "IndexError: index 1 is out of bounds"),
        ({"reward": lambda s: s.gripper}, "reward gave float64 of shape (2, 3); give float of shape (2,)"),
        ({"reward": lambda s: s.fingers + 1j}, "reward gave complex128 of shape (2,); give float of shape (2,)"),
        ({"reward": lambda s: s.fingers / 0.0}, "reward gave inf at [0] of shape (2,); give finite numbers"),
        ({"goals": lambda s, rng: s.gripper}, "goals gave float64 of shape (1, 3); give float of shape (1, 1, 3)"),
        ({"remember": lambda s: s.memory[:, :1], "memory_size": 2}, "remember gave float64 of shape (2, 1)"),
    ],
)  # fmt: skip
@pytest.mark.filterwarnings("ignore:divide by zero")
def test_what_a_function_gives_is_checked(changes, said):
    env = TabletopVectorEnv(2, WORLD, task=Task("Mine", **changes), num_threads=1)

    def play():
        env.reset(seed=0)
        env.step(np.zeros((2, 4), dtype=np.float32))

    with pytest.raises(CodeError) as error:
        play()
    assert_one_line(error.value, "test_own_task.py:", said)
    env.close()


@pytest.mark.parametrize(
    "numbers",
    [
        {"episode_steps": 0},
        {"memory_size": -1},
        {"memory_size": 1},
        {"remember": lambda s: s.memory},
        {"success": "table"},
        {"starts": np.zeros(3)},
    ],
)
def test_numbers_that_no_task_has(numbers):
    with pytest.raises(ValueError, match="task Mine: ") as error:
        Task("Mine", **numbers)
    assert "\n" not in str(error.value)


def test_a_part_of_a_view_without_memory(worlds):
    whole = Rules(Task("Mine"), worlds).view(GOAL)
    part = View.of_rows(whole.rows(), whole.goal).of(np.array([False, True]))
    np.testing.assert_array_equal(part.goal, whole.goal[1:])
    with pytest.raises(LookupError, match="memory is not known"):
        part.memory + 1


def test_an_object_that_can_be_called_is_named_by_its_file(worlds):
    class Paid:
        def __call__(self, s):
            return s.gone

    class PaidMore(Paid): ...

    with pytest.raises(CodeError, match=r"test_own_task.py:\d+: AttributeError"):
        Rules(Task("Mine", reward=PaidMore()), worlds).reward(Rules(Task("Mine"), worlds).view(GOAL))


def test_goals_in_the_air_of_a_workspace_without_room_for_them():
    low = {"workspace": {"height_m": 0.07}}
    world = Task("Low", world=low).world_from(WORLD)
    check_goals("air", world, 0.02)  # what counts as reached is less
    with pytest.raises(TandemError, match=r"goals = 'air' in a workspace 0.07 m high: they begin at 0.075 m; choose"):
        evaluate(
            IdlePolicy(), world, "air", num_episodes=1, num_steps=1,
            success_distance_m=0.05, seed=0,
        )  # fmt: skip


def test_a_task_is_found_by_name_and_in_a_file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    text = "from service.envs.task import Task\nONE = Task('One')\nTWO = Task('Two', episode_steps=7)\n"
    (tmp_path / "mine.py").write_text(text)
    two = find_task("mine.py:TWO")
    assert (two.title, two.episode_steps, two.name, dict(two.code)) == ("Two", 7, "mine.py:TWO", {"mine.py": text})
    (tmp_path / "mine.py").write_text("")  # what is recorded is what counts
    assert find_task("mine.py:TWO", {"mine.py": text}) == two
    with pytest.raises(TandemError, match=r"mine.py: it has to define one task, and has 2 of them: ONE, TWO"):
        find_task("mine.py", {"mine.py": text})
    assert find_task(Path("mine.py:TWO"), {"mine.py": text}) == two
    with pytest.raises(TandemError, match=r"unknown task 'moon'; choose one of .*, or write FILE.py:NAME"):
        find_task("moon")


def test_ours_are_files_with_nothing_but_a_task():
    found = {name: find_task(name) for name in TASKS}
    assert [task.name for task in found.values()] == list(TASKS)
    assert all(not task.code and not task.is_own and task.episode_steps == 50 for task in found.values())
    assert list(PAPERS) == list(TASKS[: len(PAPERS)])


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"episode_steps": 2 / 0.04}, "episode_steps = 50.0, memory_size = 0: give whole numbers"),
        ({"goals": np.zeros((1, 3))}, "goals is a ndarray: give a kind, or a function"),
    ],
)
def test_what_is_no_task(given, words):
    with pytest.raises(ValueError, match=words):
        Task("Mine", **given)


def test_an_unknown_setting_of_the_world_is_named():
    with pytest.raises(CodeError) as error:
        Task("Mine", world={"obstacle": []}).world_from(WORLD)
    assert_one_line(error.value, "task Mine: world: ", "obstacle")
