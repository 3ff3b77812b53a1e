"""The layouts, number by number."""

import numpy as np
import pytest

from service.config import WorldConfig
from service.envs import observations
from service.envs.batch import WorldBatch

GOALS = np.array([[0.1, 0.05, 0.3], [-0.1, -0.2, 0.025]])
ACTION = [1, 2, 3, 4]
POSITIONS = [1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11]
MIRRORED_POSITIONS = [1, -2, 3, 5, 4, 6, -7, 8, 9, -10, 11]
PRIVILEGED = [12, 13, 14, 15, 16, 17, 18, 19, 20, 21]
MIRRORED_PRIVILEGED = [12, -13, 14, 16, 15, 17, -18, 19, 21, 20]


@pytest.fixture(scope="module")
def worlds():
    """Two worlds in made-up states: every number that is observed is its own."""
    with WorldBatch(WorldConfig(), 2, num_threads=1) as batch:
        states = batch.states.copy()
        # time 1, joints 7, fingers 2, object 3, its quaternion 4; velocities: joints 7, fingers 2, object 6; contacts 2
        states[:, 1:8] += np.linspace(-0.2, 0.2, 14).reshape(2, 7)
        states[:, 8:10] = [[0.011, 0.012], [0.013, 0.014]]
        states[:, 10:13] = [[0.2, -0.1, 0.3], [-0.15, 0.12, 0.025]]
        states[:, 17:24] = np.linspace(-1.0, 1.0, 14).reshape(2, 7)
        states[:, 24:26] = [[0.21, 0.22], [0.23, 0.24]]
        states[:, 26:29] = [[0.5, 0.6, 0.7], [-0.5, -0.6, -0.7]]
        states[:, 29:32] = 9.0
        states[:, 32:34] = [[1, 0], [0, 1]]
        batch.restore(states)
        yield batch


def end_effector(worlds):
    return worlds.robot.arm.forward(worlds.states[:, 1:8]).position


def privileged(worlds):
    """(2, 10) by hand; the end effector's velocity by finite differences along the joints' motion."""
    joints, velocity, step = worlds.states[:, 1:8], worlds.states[:, 17:24], 1e-6
    after = worlds.robot.arm.forward(joints + step * velocity).position
    before = worlds.robot.arm.forward(joints - step * velocity).position
    rest = [[0.21, 0.22, 0.5, 0.6, 0.7, 1.0, 0.0], [0.23, 0.24, -0.5, -0.6, -0.7, 0.0, 1.0]]
    return np.hstack([(after - before) / (2 * step), rest])


def positions(worlds):
    """(2, 11) by hand."""
    ee = end_effector(worlds)
    objects = np.array([[0.2, -0.1, 0.3], [-0.15, 0.12, 0.025]])
    fingers = [[0.011, 0.012], [0.013, 0.014]]
    return np.hstack([ee, fingers, objects, objects - ee])


def assert_layout(found, expected, size):
    assert found.dtype == np.float32
    assert found.shape == (2, size)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-6)


def test_positions(worlds):
    assert_layout(worlds.positions(), positions(worlds), observations.POSITIONS.size)


def test_full(worlds):
    expected = np.hstack([positions(worlds), privileged(worlds), np.full((2, 1), 0.25)])
    assert_layout(worlds.full(0.25), expected, observations.PAPER.full.size)


def test_bob_value(worlds):
    relative = GOALS - [[0.2, -0.1, 0.3], [-0.15, 0.12, 0.025]]
    expected = np.hstack([positions(worlds), privileged(worlds), GOALS, relative])
    assert_layout(worlds.bob_value(GOALS), expected, observations.PAPER.bob_value.size)


def test_bobs_input_is_put_together(worlds):
    expected = np.hstack([positions(worlds), GOALS])
    found = observations.bob_observation(worlds.positions(), GOALS)
    assert_layout(found, expected, observations.BOB.size)
    np.testing.assert_array_equal(found, worlds.observe(observations.BOB, goal=GOALS))


def test_a_name_means_one_entry():
    with pytest.raises(AssertionError, match="same name"):
        observations.BOB + observations.POSITIONS


def test_normalisation_by_hand():
    """Published primitives carry these constants."""
    offset = [0, 0, 0.15, 0.02, 0.02, 0, 0, 0.15, 0, 0, 0]
    scale = [0.12, 0.12, 0.12, 0.02, 0.02, 0.12, 0.12, 0.12, 0.1, 0.1, 0.1]
    motion_scale = [0.5, 0.5, 0.5, 0.2, 0.2, 0.5, 0.5, 0.5, 0.5, 0.5]
    goal_and_way = [0, 0, 0.15, 0, 0, 0], [0.12, 0.12, 0.12, 0.1, 0.1, 0.1]
    value = observations.PAPER.bob_value.normalisation
    np.testing.assert_array_equal(value.offset, np.float32([*offset, *[0] * 8, 0.5, 0.5, *goal_and_way[0]]))
    np.testing.assert_array_equal(value.scale, np.float32([*scale, *motion_scale, *goal_and_way[1]]))
    full = observations.PAPER.full.normalisation
    np.testing.assert_array_equal(full.offset, np.float32([*offset, *[0] * 8, 0.5, 0.5, 0.5]))
    np.testing.assert_array_equal(full.scale, np.float32([*scale, *motion_scale, 0.5]))


@pytest.mark.parametrize(
    ("mirror", "vector", "expected"),
    [
        (observations.ACTION.mirror, ACTION, [1, -2, 3, 4]),
        (observations.BOB.mirror, [*POSITIONS, 12, 13, 14], [*MIRRORED_POSITIONS, 12, -13, 14]),
        (
            observations.PAPER.full.mirror,
            [*POSITIONS, *PRIVILEGED, 22],
            [*MIRRORED_POSITIONS, *MIRRORED_PRIVILEGED, 22],
        ),
        (
            observations.PAPER.bob_value.mirror,
            [*POSITIONS, *PRIVILEGED, 22, 23, 24, 25, 26, 27],
            [*MIRRORED_POSITIONS, *MIRRORED_PRIVILEGED, 22, -23, 24, 25, -26, 27],
        ),
    ],
    ids=["action", "bob", "full", "bob value"],
)
def test_mirror_swaps_fingers_and_negates_y(mirror, vector, expected):
    batch = np.array([[vector], [vector]], dtype=np.float32)
    np.testing.assert_array_equal(mirror(batch), np.array([[expected], [expected]], dtype=np.float32))
    np.testing.assert_array_equal(mirror(mirror(batch)), batch)
    assert mirror(batch).dtype == np.float32
