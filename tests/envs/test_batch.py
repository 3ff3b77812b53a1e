"""The contract of a batch: worlds are independent, exact to save and restore, and loud about bad input."""

import copy

import numpy as np
import pytest

from service.base.errors import DivergedError, TandemError
from service.config import WorkspaceConfig, WorldConfig
from service.envs.batch import WorldBatch
from service.envs.panda import FINGER_STROKE_M
from service.envs.sampling import sample_in_volume, sample_on_table

CONFIG = WorldConfig(physics_step_s=0.004, num_substeps=10)
NUM_WORLDS = 9


@pytest.fixture
def worlds():
    with WorldBatch(CONFIG, NUM_WORLDS, num_threads=2) as batch:
        batch.reset(np.random.default_rng(0))
        yield batch


def make_actions(worlds, rng):
    """Random, but steered at the object half of the time, so that states hold contacts."""
    actions = rng.uniform(-1.0, 1.0, (worlds.num_worlds, 4))
    actions[:, :3] += rng.integers(0, 2) * (worlds.object_position - worlds.ee_position) / 0.05
    return actions.astype(np.float32)


def play(worlds):
    """Five random steps."""
    rng = np.random.default_rng(1)
    for _ in range(5):
        worlds.step(make_actions(worlds, rng))


def replay(worlds, actions):
    """States after each of (T, N, 4) given actions."""
    trajectory = []
    for action in actions:
        worlds.step(action)
        trajectory.append(worlds.states.copy())
    return np.array(trajectory)


@pytest.fixture(scope="module")
def recorded():
    """Start states (N, S), actions (T, N, 4), states (T, N, S) of a run in which objects are touched."""
    rng = np.random.default_rng(0)
    with WorldBatch(CONFIG, NUM_WORLDS, num_threads=2) as batch:
        batch.reset(rng)
        start, actions, states = batch.states.copy(), [], []
        for _ in range(40):
            actions.append(make_actions(batch, rng))
            batch.step(actions[-1])
            states.append(batch.states.copy())
    assert any(state[:, -2:].any() for state in states[:20])
    return start, np.array(actions), np.array(states)


@pytest.mark.parametrize(
    ("rows", "num_threads"),
    [([4], 1), ([0, 2, 8], 3), ([8, 7, 6, 5, 4, 3, 2, 1, 0, 4, 4], 2)],
    ids=["one", "three", "eleven"],
)
def test_a_restored_state_continues_bit_identically_in_another_batch(recorded, rows, num_threads):
    _, actions, states = recorded
    with WorldBatch(CONFIG, len(rows), num_threads=num_threads) as other:
        other.reset(np.random.default_rng(99))
        other.step(actions[0, rows])
        other.restore(states[14, rows])
        np.testing.assert_array_equal(replay(other, actions[15:, rows]), states[15:, rows])


def test_worlds_that_step_alone_go_where_they_go_together(recorded, worlds):
    _, actions, states = recorded
    worlds.restore(states[14])
    turns = (np.array([1, 3, 6]), np.array([8, 0]), np.array([2, 4, 5, 7]))
    for action, expected in zip(actions[15:25], states[15:25], strict=True):
        for index in turns:
            still = np.setdiff1d(np.arange(NUM_WORLDS), index)
            before = worlds.states[still].copy()
            worlds.step(action[index], index)
            np.testing.assert_array_equal(worlds.states[still], before)
        np.testing.assert_array_equal(worlds.states, expected)


def test_reset_puts_everything_at_its_start(worlds):
    play(worlds)
    worlds.reset(np.random.default_rng(2))
    np.testing.assert_allclose(worlds.ee_position, np.tile([-0.05, 0.0, 0.08], (NUM_WORLDS, 1)), rtol=0, atol=1e-3)
    np.testing.assert_allclose(worlds.positions()[:, 3:5], FINGER_STROKE_M, rtol=0, atol=1e-7)
    np.testing.assert_array_equal(worlds.full(0.0)[:, 11:21], 0.0)
    expected = sample_on_table(np.random.default_rng(2), NUM_WORLDS, CONFIG.workspace, CONFIG.object_size_m)
    np.testing.assert_array_equal(worlds.object_position, expected)


def test_resetting_some_leaves_the_others(worlds):
    play(worlds)
    mask = np.arange(NUM_WORLDS) % 2 == 0
    before = worlds.states.copy()
    worlds.reset(np.random.default_rng(2), mask)
    np.testing.assert_array_equal(worlds.states[~mask], before[~mask])
    assert (worlds.states[mask] != before[mask]).any(axis=1).all()


def test_actions_beyond_the_range_are_clipped(worlds):
    actions = np.random.default_rng(3).choice([-1.0, 1.0], (NUM_WORLDS, 4)).astype(np.float32)
    start = worlds.states.copy()
    worlds.step(actions)
    expected = worlds.states.copy()
    worlds.restore(start)
    worlds.step(17.0 * actions)
    np.testing.assert_array_equal(worlds.states, expected)


@pytest.mark.parametrize("shape", [(NUM_WORLDS, 3), (NUM_WORLDS - 1, 4), (4,), (NUM_WORLDS, 1, 4)])
def test_actions_of_a_wrong_shape_are_refused(worlds, shape):
    before = worlds.states.copy()
    with pytest.raises(ValueError, match=r"actions.*\(9, 4\)") as caught:
        worlds.step(np.zeros(shape, dtype=np.float32))
    assert str(shape) in str(caught.value)
    np.testing.assert_array_equal(worlds.states, before)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_actions_that_are_not_finite_are_refused(worlds, value):
    actions = np.zeros((NUM_WORLDS, 4), dtype=np.float32)
    actions[5, 2] = value
    before = worlds.states.copy()
    with pytest.raises(DivergedError, match=r"actions of 1 of 9 worlds are not finite"):
        worlds.step(actions)
    np.testing.assert_array_equal(worlds.states, before)


class TestDivergence:
    BAD = 3
    OBJECT_SPIN = 17 + 9 + 3

    @pytest.fixture
    def diverging(self, worlds):
        states = worlds.states.copy()
        states[self.BAD, self.OBJECT_SPIN] = 1e200
        worlds.restore(states)
        return worlds

    def test_the_world_is_reported_and_keeps_its_last_finite_state(self, diverging):
        before = diverging.states.copy()
        actions = np.full((NUM_WORLDS, 4), 0.5, dtype=np.float32)
        diverged = diverging.step(actions)
        assert np.flatnonzero(diverged).tolist() == [self.BAD]
        np.testing.assert_array_equal(diverging.states[self.BAD], before[self.BAD])
        assert np.isfinite(diverging.full(0.0)).all()
        ((state, action),) = diverging.diverged
        np.testing.assert_array_equal(state, before[self.BAD])
        np.testing.assert_array_equal(action, actions[self.BAD])

    @pytest.mark.parametrize("num_threads", [1, 2])
    def test_mujoco_writes_nothing_about_it(self, tmp_path, monkeypatch, capfd, num_threads):
        monkeypatch.chdir(tmp_path)
        with WorldBatch(CONFIG, NUM_WORLDS, num_threads=num_threads) as worlds:
            worlds.states[self.BAD, self.OBJECT_SPIN] = 1e200
            assert worlds.step(np.zeros((NUM_WORLDS, 4), dtype=np.float32))[self.BAD]
        assert list(tmp_path.iterdir()) == []
        assert capfd.readouterr() == ("", "")

    def test_the_others_never_notice(self, recorded, diverging):
        start, actions, states = recorded
        np.testing.assert_array_equal(np.delete(diverging.states, self.BAD, axis=0), np.delete(start, self.BAD, axis=0))
        found = replay(diverging, actions[:5])
        np.testing.assert_array_equal(np.delete(found, self.BAD, axis=1), np.delete(states[:5], self.BAD, axis=1))

    def test_a_state_that_is_not_a_number_is_reported(self, worlds):
        states = worlds.states.copy()
        states[self.BAD, 1] = np.nan
        worlds.restore(states)
        diverged = worlds.step(np.zeros((NUM_WORLDS, 4), dtype=np.float32))
        assert np.flatnonzero(diverged).tolist() == [self.BAD]


class TestSampling:
    WORKSPACE = WorkspaceConfig(center_x_m=-0.1, center_y_m=0.05, length_x_m=0.2, length_y_m=0.4, height_m=0.3)

    def test_in_the_volume(self):
        found = sample_in_volume(np.random.default_rng(0), 4000, self.WORKSPACE, lowest_m=0.08)
        assert_uniform(found[:, 0], -0.2, 0.0)
        assert_uniform(found[:, 1], -0.15, 0.25)
        assert_uniform(found[:, 2], 0.08, 0.3)


def assert_uniform(values, low, high):
    """In [low, high], and its quartiles where a uniform distribution has them (4000 values: 5 sigma is under 4 %)."""
    assert low <= values.min()
    assert values.max() <= high
    quartiles = np.quantile(values, [0.25, 0.5, 0.75])
    np.testing.assert_allclose((quartiles - low) / (high - low), [0.25, 0.5, 0.75], rtol=0, atol=0.04)


class TestBlockedGrippers:
    FINGERS = slice(3, 5)

    @pytest.fixture
    def some(self):
        with WorldBatch(CONFIG, 200, num_threads=2, blocked_fraction=0.25) as batch:
            batch.reset(np.random.default_rng(0))
            yield batch

    def test_a_share_of_the_starts(self, some):
        blocked = some.states[:, -1] == 1.0
        assert 30 < blocked.sum() < 70  # 50 +- 6
        width = some.positions()[:, self.FINGERS]
        assert (width[blocked] == 0.0).all()
        assert (width[~blocked] == np.float32(FINGER_STROKE_M)).all()

    def test_they_stay_closed_and_the_others_obey(self, some):
        blocked = some.states[:, -1] == 1.0
        for finger_action in (-1.0, -1.0, 1.0, 1.0):
            actions = np.zeros((200, 4), dtype=np.float32)
            actions[:, 3] = finger_action
            some.step(actions)
            assert (np.abs(some.positions()[blocked, self.FINGERS]) < 2e-3).all()
            assert (some.states[:, -1] == blocked).all()
        assert (some.positions()[~blocked, self.FINGERS] > 0.03).all()


def test_a_copy_keeps_what_its_worlds_remember_and_whether_it_is_closed():
    with WorldBatch(WorldConfig(), 2, blocked_fraction=0.5) as worlds:
        worlds.blocked_fraction = 0.0  # as self-play does for its first games
        worlds.reset(np.random.default_rng(0))
        other = copy.deepcopy(worlds)
        assert (other.blocked_fraction, other.layout["gripper_blocked"]) == (0.0, worlds.layout["gripper_blocked"])
        assert np.array_equal(other.states, worlds.states)
        other.states[:] = 0.0
        assert worlds.states.any()
    with pytest.raises(TandemError, match="closed"):
        copy.deepcopy(worlds).step(np.zeros((2, 4), np.float32))
    other.close()
