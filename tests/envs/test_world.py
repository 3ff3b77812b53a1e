"""The physics: what must be possible in the world is, and what must not be is not."""

import mujoco
import numpy as np
import pytest

from service.config import WorldConfig
from service.envs.batch import WorldBatch
from service.envs.observations import ACTION, PAPER
from service.envs.panda import PANDA
from service.envs.sampling import sample_in_volume
from service.envs.scene import build_model
from tests.envs.scripted import CLOSE, OPEN, grasp, place_in_air
from tests.envs.world_soak import soak

FINE = {"physics_step_s": 0.002, "num_substeps": 20}
COARSE = {"physics_step_s": 0.005, "num_substeps": 8}
"""The physics of pre-training."""


def act(worlds, *action, num_steps=1):
    """The same action in every world; returns the end effectors' displacement, metres."""
    before = worlds.ee_position.copy()
    for _ in range(num_steps):
        worlds.step(np.tile(np.float32(action), (worlds.num_worlds, 1)))
    return worlds.ee_position - before


def spread_out(worlds, rng, lowest_m=PANDA.lowest_m):
    """Put every arm over a random point of the workspace, at rest, and every object out of its way."""
    states = worlds.states.copy()
    target = sample_in_volume(rng, worlds.num_worlds, worlds.config.workspace, lowest_m=lowest_m)
    arm = worlds.robot.arm
    states[:, 1:8] = arm.solve(np.tile(arm.home, (worlds.num_worlds, 1)), target, num_iterations=60)
    states[:, 10] = -0.75
    worlds.restore(states)


@pytest.mark.parametrize(
    ("shape", "physics", "num_worlds", "least_share"),
    [
        ("cube", FINE, 16, 1.0),
        ("cube", COARSE, 30, 1.0),
        ("sphere", COARSE, 30, 0.95),
    ],
    ids=["cube", "cube-coarse", "sphere-coarse"],
)
def test_pick_and_place_in_the_air_and_hold(shape, physics, num_worlds, least_share):
    placement = place_in_air(WorldConfig(object=shape, **physics), num_worlds, seed=0)
    assert placement.grasped.mean() >= least_share
    arrived = placement.distance_m < 0.01
    assert arrived.mean() >= least_share
    held = arrived & (placement.distance_after_hold_m < 0.01) & (placement.slip_m <= 0.005)
    assert held.mean() >= least_share


@pytest.mark.parametrize("physics", [FINE, COARSE], ids=["fine", "coarse"])
@pytest.mark.parametrize("shape", ["cube", "sphere"])
def test_an_object_at_rest_stays(shape, physics):
    with WorldBatch(WorldConfig(object=shape, **physics), 4) as worlds:
        worlds.reset(np.random.default_rng(0))
        before = worlds.object_position.copy()
        furthest = 0.0
        for _ in range(100):
            act(worlds, 0, 0, 0, 0)
            furthest = max(furthest, np.linalg.norm(worlds.object_position - before, axis=1).max())
        assert furthest < 1e-3


@pytest.mark.parametrize(
    ("shape", "physics", "num_steps"),
    [("cube", FINE, 50), ("sphere", COARSE, 50)],
    ids=["cube", "sphere-coarse"],
)
def test_rough_play_breaks_nothing(shape, physics, num_steps):
    extremes = soak(WorldConfig(object=shape, **physics), num_worlds=60, num_steps=num_steps, seed=0)
    assert extremes.contact_share > 0.05
    assert extremes.within_bounds(), extremes


def test_contacts_are_those_that_primitives_are_trained_with():
    ball = {"shape": "sphere", "size_m": (0.05,)}
    model = build_model(WorldConfig(fixture="box", obstacles=[ball], start_height_m=0.2))
    assert np.unique(model.geom_friction[:, 1:], axis=0).tolist() == [[0.005, 0.0001]]
    sides = np.array([model.geom(f"fixture_{name}").pos for name in ("near", "far", "left", "right")])
    np.testing.assert_allclose(np.sort(sides, axis=0)[[0, -1]], [[-0.0475, -0.0475, 0.025], [0.0475, 0.0475, 0.025]])
    np.testing.assert_allclose(sides.sum(axis=0), [0.0, 0.0, 0.1])
    option = model.opt
    assert (option.impratio, option.noslip_iterations, option.iterations, option.tolerance) == (1.0, 5, 50, 1e-8)
    expected = {  # sliding friction, time, least and most impedance, dimensions, priority, type, affinity
        "table": (1.0, 0.01, 0.95, 0.99, 3, 0, 4, 3),
        "hand": (0.3, 0.01, 0.95, 0.99, 3, 2, 1, 0),
        "left_shaft": (0.3, 0.01, 0.95, 0.99, 3, 2, 1, 0),
        "left_pad_front": (1.0, 0.01, 0.9, 0.95, 4, 2, 1, 0),
        "object": (1.0, 0.01, 0.95, 0.99, 3, 0, 2, 1),
        "obstacle_1": (1.0, 0.01, 0.95, 0.99, 6, 1, 2, 11),
        "ground": (1.0, 0.01, 0.95, 0.99, 3, 0, 8, 0),
        "fixture_near": (1.0, 0.01, 0.95, 0.99, 3, 0, 0, 3),
    }
    for name, numbers in expected.items():
        geom = model.geom(name)
        touching = (geom.condim[0], geom.priority[0], geom.contype[0], geom.conaffinity[0])
        assert (geom.friction[0], geom.solref[0], *geom.solimp[:2], *touching) == numbers, name


def test_the_palm_slides_over_a_cube_and_does_not_sink_into_it():
    """Of two geoms of one priority MuJoCo takes the larger friction, the cube's: the palm wedged it on the table."""
    with WorldBatch(WorldConfig(**COARSE), 1) as worlds:
        states = worlds.states.copy()
        arm = worlds.robot.arm
        states[:, 1:8] = arm.solve(arm.home[None], np.array([[0.0, 0.0, 0.03]]), num_iterations=60)
        states[:, 10:13] = [0.0, 0.0, 0.025]
        worlds.restore(states)
        act(worlds, 0, 0, -1, OPEN, num_steps=5)
        data = mujoco.MjData(worlds.model)
        mujoco.mj_setState(
            worlds.model, data, worlds.states[0, worlds.layout.physics], mujoco.mjtState.mjSTATE_FULLPHYSICS
        )
        mujoco.mj_forward(worlds.model, data)
        pressed = {frozenset((int(contact.geom1), int(contact.geom2))): contact for contact in data.contact}
        contact = pressed[frozenset((worlds.model.geom("hand").id, worlds.model.geom("object").id))]
        assert contact.friction[0] == 0.3
        assert -1.5e-3 < contact.dist < 0.0


def test_no_action_no_motion():
    with WorldBatch(WorldConfig(), 50) as worlds:
        spread_out(worlds, np.random.default_rng(0))
        drift = np.linalg.norm(act(worlds, 0, 0, 0, 0, num_steps=40), axis=1)
        assert drift.max() < 0.5e-3


@pytest.mark.parametrize(("axis", "sign"), [(0, -1.0), (1, 1.0), (2, -1.0)])
def test_a_full_action_moves_a_few_centimetres_along_its_axis(axis, sign):
    action = np.zeros(4)
    action[axis] = sign
    with WorldBatch(WorldConfig(start_height_m=0.2), 1) as worlds:
        from_rest = act(worlds, *action)[0]
        assert 0.015 < sign * from_rest[axis] < 0.05
        moving = act(worlds, *action)[0]
        assert 0.02 < sign * moving[axis] < 0.05
        across = np.delete(moving, axis)
        assert np.abs(across).max() < 0.1 * np.abs(moving[axis])


def test_actions_count_from_where_the_end_effector_is():
    """An arm that was held at the table for long comes up at once: no target winds up."""
    with WorldBatch(WorldConfig(), 1) as worlds:
        act(worlds, 0, 0, -1, 0, num_steps=40)
        low = worlds.ee_position[0, 2]
        assert low > PANDA.lowest_m - 0.002
        assert act(worlds, 0, 0, 1, 0)[0, 2] > 0.01


def test_fingers_open_and_close():
    with WorldBatch(WorldConfig(), 1) as worlds:
        fingers = [worlds.positions()[0, 3:5].copy()]
        for grip in (CLOSE, CLOSE, OPEN, OPEN, OPEN):
            act(worlds, 0, 0, 0, grip)
            fingers.append(worlds.positions()[0, 3:5].copy())
    start, _, closed, _, _, opened = fingers
    np.testing.assert_allclose(start, 0.04, rtol=0, atol=1e-6)
    np.testing.assert_allclose(closed, 0.0, rtol=0, atol=1e-3)
    np.testing.assert_allclose(opened, 0.04, rtol=0, atol=1e-3)


@pytest.mark.parametrize("shape", ["cube", "sphere"])
def test_both_fingers_feel_what_they_hold(shape):
    with WorldBatch(WorldConfig(object=shape), 20) as worlds:
        worlds.reset(np.random.default_rng(0))
        assert not worlds.contacts().any()
        grasp(worlds)
        assert worlds.contacts().all()
        act(worlds, 0, 0, 0, OPEN, num_steps=3)
        act(worlds, 0, 0, 1, OPEN, num_steps=5)
        assert not worlds.contacts().any()


def test_each_finger_feels_on_its_own():
    """The right finger is at y > 0, so a closed gripper that sweeps towards +y touches with the right one only."""
    with WorldBatch(WorldConfig(), 1) as worlds:
        states = worlds.states.copy()
        states[:, 8:10] = 0.0
        states[:, 10:13] = [-0.05, 0.08, 0.025]
        worlds.restore(states)
        act(worlds, 0, 0, -1, -1, num_steps=3)
        touched = []
        for _ in range(6):
            act(worlds, 0, 1, 0, -1)
            touched.append(worlds.contacts()[0])
        assert np.array(touched)[:, 1].any()
        assert not np.array(touched)[:, 0].any()


def mirror_state(states):
    """States reflected in y; joints 1, 3, 5 and 7 turn about axes in the mirror, the hand is 45 deg off joint 7."""
    mirrored = states.copy()
    joints, fingers, object_y, quaternion, velocity = 1, 8, 11, 13, 17
    mirrored[:, [joints, joints + 2, joints + 4, object_y, quaternion + 1, quaternion + 3]] *= -1
    mirrored[:, joints + 6] = np.pi / 2 - states[:, joints + 6]
    mirrored[:, [fingers, fingers + 1]] = states[:, [fingers + 1, fingers]]
    # joints 1, 3, 5, 7, then of the object: linear y, angular x and z
    mirrored[:, [velocity + index for index in (0, 2, 4, 6, 10, 12, 14)]] *= -1
    mirrored[:, [velocity + 7, velocity + 8]] = states[:, [velocity + 8, velocity + 7]]
    mirrored[:, [-2, -1]] = states[:, [-1, -2]]
    return mirrored


def make_symmetric(model):
    """Balls instead of the real links, whose mass is a little off the middle."""
    for index in range(1, 8):
        link = model.body(f"link{index}")
        off_plane = 1 if index % 2 else 2
        link.ipos[off_plane] = 0.0
        if index == 7:
            link.ipos[:2] = 0.0
        link.iquat[:] = [1.0, 0.0, 0.0, 0.0]
        link.inertia[:] = link.inertia.mean()
    mujoco.mj_setConst(model, mujoco.MjData(model))


def test_the_task_has_no_left_and_right():
    """A run's reflection is the run of its reflection; noslip goes through contacts in an order, so it is off here."""
    rng = np.random.default_rng(0)
    with WorldBatch(WorldConfig(), 30) as worlds, WorldBatch(WorldConfig(), 30) as reflected:
        for model in (worlds.model, reflected.model):
            make_symmetric(model)
            model.opt.noslip_iterations = 0
        worlds.reset(rng)
        reflected.restore(mirror_state(worlds.states))
        np.testing.assert_allclose(reflected.full(0.5), PAPER.full.mirror(worlds.full(0.5)), rtol=0, atol=1e-12)
        for tolerance in (1e-7, 1e-5, 1e-5, 1e-5):  # contacts magnify the last bits, so not for longer
            actions = rng.uniform(-1.0, 1.0, (30, 4)).astype(np.float32)
            worlds.step(actions)
            reflected.step(ACTION.mirror(actions))
            difference = np.abs(PAPER.full.mirror(worlds.full(0.5)) - reflected.full(0.5))
            assert difference[:, :11].max() < tolerance


def test_nothing_starts_inside_fingers_that_are_closed_in_some_games():
    high = WorldConfig(object={"shape": "box", "size_m": (0.04, 0.04, 0.11)}, physics_step_s=0.005, num_substeps=8)
    with WorldBatch(high, 1000, num_threads=1, blocked_fraction=0.5) as worlds:
        worlds.reset(np.random.default_rng(0))
        before = worlds.object_position.copy()
        worlds.step(np.zeros((1000, 4), dtype=np.float32))
        assert np.linalg.norm(worlds.object_position - before, axis=1).max() < 0.002
