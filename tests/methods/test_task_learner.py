import numpy as np
import pytest

from service.config.skills import SACConfig
from service.methods.task import Hindsight, TaskLearning
from tests.methods.trials import SMALL, small_trial


def loop_of(method, champion, **changes):
    return TaskLearning(small_trial(method, **changes).begin("no registry here", None), champion).loop


def test_every_setting_reaches_the_learner(champion):
    settings = {
        "num_worlds": 3,
        "gradient_steps": 5,
        "batch_size": 24,
        "learning_rate": 2e-3,
        "gamma": 0.83,
        "tau": 0.17,
        "initial_entropy_coefficient": 0.37,
        "learn_entropy_coefficient": False,
        "target_entropy": -0.7,
        "hidden_sizes": (12, 7),
        "critic_layer_norm": False,
        "learning_starts": 160,
    }
    assert all(settings[name] != field.default for name, field in SACConfig.model_fields.items())
    loop = loop_of("ours", champion, sac=settings, run={"total_env_steps": 500})
    assert loop.worlds.num_worlds == loop.replay.num_worlds == 3
    assert loop.replay.num_steps == 167  # all 500, in whole steps of 3 worlds
    num_outputs = 2 * champion.primitives.num_primitives
    assert [layer.out_features for layer in loop.learner.actor.layers[::2]] == [12, 7, num_outputs]
    assert [layer.out_features for layer in loop.learner.critics.first[::2]] == [12, 7, 1]
    sizes = []
    make_batch = loop.make_batch
    loop.make_batch = lambda replay, size, rng: sizes.append(size) or make_batch(replay, size, rng)
    assert loop.play(159) == {}
    found = loop.play(3)  # the first step past 160
    assert sizes == [5 * 24]
    assert loop.num_updates == 5
    assert found["entropy_coefficient"] == pytest.approx(0.37, rel=0.05)
    assert loop.learner.config.model_dump() == SACConfig(**settings).model_dump()
    loop.worlds.close()


def test_actions_are_uniform_first(champion):
    loop = loop_of("scratch-monolithic", champion)
    loop.learner.act = lambda inputs: pytest.fail("the actor was asked")
    loop.play(SMALL["learning_starts"])
    actions = loop.replay.state()["action"]
    assert actions.shape == (50, 4, 4)
    assert abs(actions.mean()) < 0.1
    assert actions.std() == pytest.approx(1 / np.sqrt(3), rel=0.1)
    loop.worlds.close()


def test_relabelled_goals_are_where_the_object_came_to_later_in_the_episode(champion):
    """Every transition is drawn as it was kept, but for the goal and what is paid for it."""
    loop = loop_of("ours-her", champion)
    loop.play(SMALL["learning_starts"])  # an episode of 50 steps in each of four worlds
    state = loop.replay.state()
    state["following"][..., 5:8] = 0.01 * np.stack([*np.mgrid[:50, :4], np.zeros((50, 4))], axis=-1)  # (step, world, 0)
    loop.replay.load_state(state)
    seen, paid = [], []
    worlds = loop.worlds
    rewards = worlds.rewards
    worlds.rewards = lambda rows, goal: seen.append((rows["following"], goal)) or rewards(rows, goal)
    batch = Hindsight(worlds, (1.0, 1.0))(loop.replay, 400, np.random.default_rng(0))
    ((following, goal),) = seen
    step, world, _ = (100 * following[:, 5:8]).round().astype(int).T
    goal_step, goal_world, _ = (100 * goal).round().astype(int).T
    np.testing.assert_array_equal(goal_world, world)
    assert (goal_step >= step).all()
    early = step < 10
    assert early.sum() > 40
    # any later step with equal chance: of 40 to 50 steps about half are before the 30th, not all are the last
    assert 0.25 < (goal_step[early] < 30).mean() < 0.75
    paid = (np.linalg.norm(following[:, 5:8] - goal, axis=1) <= 0.04).astype(float)
    np.testing.assert_array_equal(batch.rewards, paid)
    assert 0.0 < paid.mean() < 1.0
    np.testing.assert_allclose(batch.inputs[:, 17:20] * 0.12 + [0, 0, 0.15], goal, atol=1e-6)
    np.testing.assert_array_equal(batch.inputs[:, 17:20], batch.next_inputs[:, 17:20])
    np.testing.assert_array_equal(batch.actions, state["action"][step, world])
    worlds.close()


def test_without_hindsight_transitions_are_as_they_were(champion):
    loop = loop_of("ours", champion)
    loop.play(SMALL["learning_starts"])
    state = loop.replay.state()
    batch = Hindsight(loop.worlds, None)(loop.replay, 100, np.random.default_rng(0))
    goals = (state["goal"].reshape(-1, 3) - [0, 0, 0.15]) / 0.12
    acted = state["action"].reshape(len(goals), -1)
    kept = np.column_stack([goals, state["reward"].reshape(-1, 1), acted])
    drawn = np.column_stack([batch.inputs[:, 17:20], batch.rewards, batch.actions])
    assert (np.abs(drawn[:, None] - kept[None]).max(2).min(1) < 1e-5).all()
    loop.worlds.close()


@pytest.mark.parametrize(
    ("method", "shares"),
    [("ours-her", (0.8, 0.4, 0.0, 0.0)), ("scratch-monolithic-her", (0.8,) * 4), ("ours", (0,) * 4)],
)
def test_the_share_of_relabelled_goals(champion, method, shares):
    loop, relabelled = loop_of(method, champion), []
    loop.play(SMALL["learning_starts"])
    rewards = loop.worlds.rewards
    loop.worlds.rewards = lambda following, goal: relabelled.append(len(goal)) or rewards(following, goal)
    assert loop.make_batch.share == shares[0]
    for progress, share in zip((0.0, 0.25, 0.5, 1.0), shares, strict=True):
        loop.make_batch.set_progress(progress)
        loop.make_batch(loop.replay, 10_000, np.random.default_rng(0))
        assert (relabelled.pop() if share else 0) == pytest.approx(10_000 * share, abs=200)
        assert not relabelled
    loop.worlds.close()


@pytest.mark.parametrize(("settings", "sign"), [({"target_entropy": -9.0}, -1), ({"target_entropy": 9.0}, 1)])
def test_the_entropy_coefficient_goes_where_the_target_entropy_is(champion, settings, sign):
    """An actor that is more random than the target gets a smaller coefficient, and the other way round."""
    sac = {"num_worlds": 4, "gradient_steps": 8, "batch_size": 16, "learning_starts": 40, "learning_rate": 1e-2}
    found = []
    for changed in (settings, {**settings, "learn_entropy_coefficient": False}):
        loop = loop_of("ours", champion, sac=sac | changed, run={"total_env_steps": 500})
        loop.play(60)
        found.append(loop.play(40)["entropy_coefficient"])
        loop.worlds.close()
    learned, fixed = found
    assert fixed == pytest.approx(SACConfig().initial_entropy_coefficient)
    assert sign * (learned - fixed) > 0.01
