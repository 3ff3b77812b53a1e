"""What worlds draw anew at each start: the physics from a bank of models, late commands, errors of what is seen."""

import mujoco
import numpy as np
import pytest

from service.config import WorldConfig
from service.envs.batch import WorldBatch
from service.envs.observations import POSITIONS
from service.envs.randomisation import KEYS, ModelBank, normal
from service.envs.rules import Rules
from service.envs.task import Task

COARSE = {"physics_step_s": 0.005, "num_substeps": 8}
EVERYTHING = {
    "num_models": 4,
    "object_size": [0.8, 1.2],
    "object_mass_kg": [0.05, 1.0],
    "friction": [0.3, 1.2],
    "gain": [0.8, 1.2],
    "damping": [0.5, 1.5],
    "table_height_m": [-0.01, 0.01],
    "delay_steps": [0, 2],
    "object_noise_m": [0.002, 0.01],
    "object_offset_m": [0.005, 0.02],
}


def world(num_commands=0, **randomisation):
    tree = {**COARSE, "observed": {"num_commands": num_commands}, "randomisation": randomisation}
    return WorldConfig.model_validate(tree)


def actions_of(num_steps, num_worlds, seed=1):
    return np.random.default_rng(seed).uniform(-1.0, 1.0, (num_steps, num_worlds, 4)).astype(np.float32)


def test_noise_is_standard_normal_and_a_function_of_key_and_count():
    key = np.random.default_rng(0).integers(KEYS, size=2000).astype(np.float64)
    first, second = normal(key, np.zeros(2000), 3), normal(key, np.ones(2000), 3)
    assert abs(first.mean()) < 0.03
    assert abs(first.std() - 1.0) < 0.03
    assert abs(np.corrcoef(first.ravel(), second.ravel())[0, 1]) < 0.05
    assert abs(np.corrcoef(first[:, 0], first[:, 1])[0, 1]) < 0.08
    np.testing.assert_array_equal(normal(key[5:6], np.zeros(1), 3)[0], first[5])


def test_a_bank_covers_each_range_evenly_and_its_models_are_as_drawn():
    bank = ModelBank(world(**EVERYTHING))
    assert len(bank) == 4
    for name, values in bank.drawn.items():
        low, high = EVERYTHING[name]
        assert sorted(((values - low) / (high - low) * 4).astype(int)) == [0, 1, 2, 3], name
    for index, model in enumerate(bank.models):
        drawn = {name: values[index] for name, values in bank.drawn.items()}
        body, geom = model.body("object"), model.geom("object")
        assert body.mass[0] == pytest.approx(drawn["object_mass_kg"])
        np.testing.assert_allclose(geom.size, 0.025 * drawn["object_size"])
        assert geom.friction[0] == pytest.approx(drawn["friction"])
        nominal = bank.nominal.actuator("joint1")
        servo = model.actuator("joint1")
        assert servo.gainprm[0] == pytest.approx(nominal.gainprm[0] * drawn["gain"])
        assert servo.biasprm[1] == pytest.approx(nominal.biasprm[1] * drawn["gain"])
        assert servo.biasprm[2] == pytest.approx(nominal.biasprm[2] * drawn["damping"])
        finger = model.actuator("left_finger")
        np.testing.assert_array_equal(finger.gainprm, bank.nominal.actuator("left_finger").gainprm)
        assert model.geom("table").pos[2] - bank.nominal.geom("table").pos[2] == pytest.approx(drawn["table_height_m"])
        rest_m = 0.025 * drawn["object_size"] + drawn["table_height_m"]
        assert bank.rest_heights_m[index] == pytest.approx(rest_m)


def test_fingers_do_not_sink_into_a_raised_table():
    """A finger has several geoms, which MuJoCo seeks by the tree of bounds of the table."""
    with WorldBatch(world(num_models=1, table_height_m=[0.03, 0.03]), 1, num_threads=1) as worlds:
        worlds.reset(np.random.default_rng(0))
        worlds.put_objects(np.array([[0.1, 0.15, 0.055]]), slice(0, 1))
        for _ in range(25):
            worlds.step(np.float32([[0, 0, -1, 0]]))
        model = worlds.bank.models[0]
        data = mujoco.MjData(model)
        mujoco.mj_setState(model, data, worlds.states[0, worlds.layout.physics], mujoco.mjtState.mjSTATE_FULLPHYSICS)
        mujoco.mj_forward(model, data)
        table = model.geom("table").id
        touching = [contact.dist for contact in data.contact[: data.ncon] if table in contact.geom]
        fingers = [geom for geom in range(model.ngeom) if "finger" in model.body(model.geom_bodyid[geom]).name]
        reach = (abs(data.geom_xmat[geom].reshape(3, 3)[2]) @ model.geom_aabb[geom, 3:] for geom in fingers)
        lowest_m = min(data.geom_xpos[geom, 2] - down for geom, down in zip(fingers, reach, strict=True))
        assert len(touching) > 0
        assert lowest_m > 0.027


@pytest.mark.parametrize("fixture", ["wall", "box"])
def test_what_stands_on_the_table_goes_up_with_it(fixture):
    config = world(num_models=1, table_height_m=[0.02, 0.02]).model_copy(update={"fixture": fixture})
    with WorldBatch(config, 1, num_threads=1) as worlds:
        worlds.reset(np.random.default_rng(0))
        model = worlds.bank.models[0]
        data = mujoco.MjData(model)
        mujoco.mj_setState(model, data, worlds.states[0, worlds.layout.physics], mujoco.mjtState.mjSTATE_FULLPHYSICS)
        if fixture == "box":
            data.mocap_pos[0] = worlds.box_place[0]
        mujoco.mj_forward(model, data)
        bottoms = [
            data.geom_xpos[index][2] - model.geom_size[index][2]
            for index in range(model.ngeom)
            if model.geom(index).name.startswith("fixture_")
        ]
        assert min(bottoms) == pytest.approx(0.02, abs=1e-6)
        assert worlds.object_position[0, 2] == pytest.approx(0.045)


def test_the_largest_object_starts_clear_of_the_gripper_and_of_fixtures():
    """Objects up to 9 cm high, under fingers at 8 cm; places are drawn for the largest, up to 7.5 cm wide."""
    tall = {"shape": "cylinder", "size_m": [0.05, 0.06]}
    block = {"shape": "box", "size_m": [0.1, 0.1, 0.02], "position_m": [0.05, 0.0]}
    config = world(num_models=8, object_size=[1.0, 1.5])
    config = WorldConfig.model_validate(config.model_dump() | {"object": tall, "fixtures": [block]})
    full_physics = mujoco.mjtState.mjSTATE_FULLPHYSICS
    with WorldBatch(config, 300, num_threads=1) as worlds:
        worlds.reset(np.random.default_rng(0))
        data = [mujoco.MjData(model) for model in worlds.bank.models]
        for state in worlds.states:
            index = int(state[worlds.layout["model"]][0])
            model, here = worlds.bank.models[index], data[index]
            mujoco.mj_setState(model, here, state[worlds.layout.physics], full_physics)
            mujoco.mj_forward(model, here)
            touched = [contact for contact in here.contact[: here.ncon] if contact.dist < -1e-4]
            assert not touched, [model.geom(int(geom)).name for geom in touched[0].geom]


def test_a_late_command_does_later_what_it_would_have_done():
    actions = actions_of(6, 3)
    with WorldBatch(world(), 3, num_threads=1) as now, WorldBatch(world(delay_steps=[2, 2]), 3, num_threads=1) as late:
        now.reset(np.random.default_rng(0))
        late.reset(np.random.default_rng(0))
        idle = np.zeros((2, 3, 4), np.float32)
        for one, other in zip([*idle, *actions[:4]], actions, strict=True):
            now.step(one)
            late.step(other)
        np.testing.assert_array_equal(late.states[:, late.layout.physics], now.states[:, now.layout.physics])


def test_last_commands_are_seen_the_newest_first_and_none_at_a_start():
    with WorldBatch(world(num_commands=2), 3, num_threads=1) as worlds:
        worlds.reset(np.random.default_rng(0))
        seen = worlds.observed.positions
        assert seen.size == POSITIONS.size + 8
        assert not worlds.positions()[:, seen["command_1"].start :].any()
        first, second, third = 1.5 * actions_of(3, 3)
        for action in (first, second, third):
            worlds.step(action)
        np.testing.assert_allclose(worlds.positions()[:, seen["command_1"]], np.clip(third, -1, 1))
        np.testing.assert_allclose(worlds.positions()[:, seen["command_2"]], np.clip(second, -1, 1))
        np.testing.assert_array_equal(worlds.full(0.0)[:, : seen.size], worlds.positions())


def test_positions_have_the_errors_and_value_networks_see_none():
    with WorldBatch(world(object_offset_m=[0.01, 0.01]), 200, num_threads=1) as worlds:
        worlds.reset(np.random.default_rng(0))
        error = worlds.positions()[:, POSITIONS["object"]] - worlds.object_position
        np.testing.assert_allclose(np.linalg.norm(error, axis=1), 0.01, rtol=1e-3)
        assert np.linalg.norm(error.mean(axis=0)) < 0.002  # in any direction
        way = worlds.positions()[:, POSITIONS["object_from_effector"]] - (worlds.object_position - worlds.ee_position)
        np.testing.assert_allclose(way, error, atol=1e-6)
        value = worlds.bob_value(worlds.object_position + 0.1)
        layout = worlds.observed.bob_value
        np.testing.assert_allclose(value[:, layout["object"]], worlds.object_position, atol=1e-6)
        np.testing.assert_allclose(value[:, layout["goal_from_object"]], 0.1, atol=1e-6)


def test_noise_is_new_at_each_step_and_the_same_for_the_same_state():
    with WorldBatch(world(object_noise_m=[0.01, 0.01]), 300, num_threads=1) as worlds:
        worlds.reset(np.random.default_rng(0))
        errors = []
        for _ in range(2):
            errors.append(worlds.positions()[:, POSITIONS["object"]] - worlds.object_position)
            before = worlds.positions()
            np.testing.assert_array_equal(worlds.positions(), before)
            worlds.step(np.zeros((300, 4), np.float32))
        assert np.std(errors[0]) == pytest.approx(0.01, rel=0.1)
        assert abs(np.corrcoef(errors[0].ravel(), errors[1].ravel())[0, 1]) < 0.1


def test_saved_states_go_on_exactly_in_another_batch():
    config = world(num_commands=1, **EVERYTHING)
    actions = actions_of(8, 6)
    with WorldBatch(config, 6, num_threads=1) as one, WorldBatch(config, 6, num_threads=2) as other:
        one.reset(np.random.default_rng(3))
        for action in actions[:4]:
            one.step(action)
        other.restore(one.states.copy())
        for action in actions[4:]:
            one.step(action)
            other.step(action)
        np.testing.assert_array_equal(one.states, other.states)
        np.testing.assert_array_equal(one.positions(), other.positions())
        assert len(np.unique(one.states[:, one.layout["model"]])) > 1


def test_a_tasks_own_starts_are_on_the_table_of_their_world():
    config = world(num_models=8, table_height_m=[-0.01, 0.01], object_size=[0.75, 1.25])
    rng = np.random.default_rng(0)
    with WorldBatch(config, 32, num_threads=1) as worlds:
        worlds.reset(rng)
        before, rest = worlds.object_position.copy(), worlds.rest_heights
        np.testing.assert_array_equal(before[:, 2:], rest)
        assert rest.min() < 0.02 < 0.03 < rest.max()
        Rules(Task("Kept", starts=lambda s, rng: s.objects.place), worlds).place(rng)
        np.testing.assert_array_equal(worlds.object_position, before)
        fixed = Task("Fixed", starts=lambda s, rng: np.broadcast_to([0.0, 0.1, 0.025], s.objects.place.shape))
        Rules(fixed, worlds).place(rng, slice(0, 16))
        np.testing.assert_allclose(worlds.object_position[:16, 2:], np.maximum(rest[:16], 0.025))
        np.testing.assert_array_equal(worlds.object_position[16:], before[16:])


def test_what_stands_on_another_is_raised_with_it():
    config = world(num_models=8, table_height_m=[-0.01, 0.01])
    config = WorldConfig.model_validate(config.model_dump() | {"objects": ["cube", "cube"], "start_height_m": 0.2})
    rng, stack = np.random.default_rng(0), [[0.0, 0.1, 0.025], [0.0, 0.1, 0.075]]
    with WorldBatch(config, 32, num_threads=1) as worlds:
        worlds.reset(rng)
        Rules(Task("Stack", starts=lambda s, rng: np.tile(stack, (len(s.elapsed), 1, 1))), worlds).place(rng)
        lower, upper = worlds.object_position[:, 2], worlds.object_position[:, 5]
        np.testing.assert_allclose(lower, np.maximum(worlds.rest_heights[:, 0], 0.025))
        np.testing.assert_allclose(upper - lower, 0.05)
