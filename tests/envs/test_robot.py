"""Robots by description: arms and grippers that nobody here drew, in the same scene."""

from importlib.util import find_spec
from pathlib import Path

import mujoco
import numpy as np
import pytest

from service.base.errors import ConfigError
from service.config import dump_config, load_config
from service.envs.batch import DISPLACEMENT_M, WorldBatch
from service.envs.objects import GRIPPER_BIT
from tests.envs.robots import (
    GANTRY,
    GANTRY_DESCRIPTION,
    PINCHER,
    PINCHER_DESCRIPTION,
    URDF,
    URDF_DESCRIPTION,
    write_robot,
)
from tests.envs.scripted import CLOSE, drive, grasp, place_in_air
from tests.envs.test_meshes import write_box
from tests.runs.runs import assert_one_line

ROBOTS = Path(__file__).parents[2] / "configs" / "robots"
RECIPE = ROBOTS.parent / "pretrain" / "panda_cube.yaml"
SMALL = ("world.workspace.length_x_m=0.25", "world.workspace.length_y_m=0.25", "world.workspace.height_m=0.2")


def world_of(robot, *overrides):
    return load_config(None, [f"world.robot={robot}", *SMALL, *overrides]).world


@pytest.fixture
def pincher(tmp_path):
    return write_robot(tmp_path)


@pytest.fixture
def gantry(tmp_path):
    return write_robot(tmp_path, GANTRY, GANTRY_DESCRIPTION)


@pytest.fixture
def sixer(tmp_path):
    return write_robot(tmp_path, URDF, URDF_DESCRIPTION)


def test_an_arm_of_five_joints_with_one_jaw_picks_things_up(pincher):
    with WorldBatch(world_of(pincher, "world.object_size_m=0.04"), 12) as worlds:
        worlds.reset(np.random.default_rng(0))
        assert worlds.states.shape[1] == 1 + (6 + 7) + (6 + 6) + 2
        np.testing.assert_allclose(worlds.positions()[:, 3:5], 0.035, atol=1e-6)  # each half of the opening
        np.testing.assert_allclose(worlds.ee_position, [[-0.05, 0.0, 0.08]] * 12, atol=1e-3)
        grasp(worlds)
        assert worlds.contacts().all(axis=1).mean() >= 0.9
        above = worlds.ee_position + np.array([0.0, 0.0, 0.1])
        for _ in drive(worlds, lambda: above, CLOSE, 12):
            pass
        assert (worlds.object_position[:, 2] > 0.08).mean() >= 0.9


def test_a_gantry_with_a_hand_of_another_file_and_turning_fingers(gantry):
    with WorldBatch(world_of(gantry), 1) as worlds:
        worlds.reset(np.random.default_rng(0))
        np.testing.assert_allclose(worlds.ee_position, [[-0.05, 0.0, 0.08]], atol=1e-6)
        np.testing.assert_allclose(worlds.positions()[0, 3:5], 0.08, atol=1e-6)
        for axis in range(3):
            action = np.zeros((1, 4), dtype=np.float32)
            action[0, axis] = 1.0
            worlds.reset(np.random.default_rng(0))
            before = worlds.ee_position.copy()
            for _ in range(3):
                worlds.step(action)
            moved = (worlds.ee_position - before)[0]
            assert moved[axis] > DISPLACEMENT_M
            assert np.abs(np.delete(moved, axis)).max() < 0.005
        for _ in range(10):
            worlds.step(np.float32([[0, 0, 0, -1]]))
        np.testing.assert_allclose(worlds.positions()[0, 3:5], 0.0, atol=2e-3)


def test_an_arm_of_a_urdf_is_where_mujoco_has_it(sixer):
    with WorldBatch(world_of(sixer), 1) as worlds:
        model, arm = worlds.model, worlds.robot.arm
        np.testing.assert_allclose(model.body("robot/shoulder").pos, [0.0, 0.0, 0.15])  # the base stays a body
        np.testing.assert_allclose(worlds.ee_position, [[-0.05, 0.0, 0.08]], atol=1e-5)
        lower, upper = model.jnt_range[:6].T
        limited = model.jnt_limited[:6].astype(bool)
        assert limited.tolist() == [True, True, True, True, False, True]  # "roll" is continuous
        rng = np.random.default_rng(0)
        joints = np.where(limited, rng.uniform(lower, upper, (20, 6)), rng.uniform(-3.0, 3.0, (20, 6)))
        found, data = arm.forward(joints), mujoco.MjData(model)
        for row, values in enumerate(joints):
            data.qpos[:6] = values
            mujoco.mj_kinematics(model, data)
            tool = data.body("robot/tool")
            np.testing.assert_allclose(found.position[row], tool.xpos, rtol=0, atol=1e-10)
            np.testing.assert_allclose(found.rotation[row], tool.xmat.reshape(3, 3), rtol=0, atol=1e-10)


def with_mesh(name):
    """The arm with a mesh in place of a sphere."""
    sphere, mesh = '<geometry><sphere radius="0.06"/></geometry>', f'<geometry><mesh filename="{name}"/></geometry>'
    assert sphere in URDF
    return URDF.replace(sphere, mesh)


@pytest.mark.parametrize("address", ["../meshes/block.obj", "package://arms/meshes/block.obj"])
def test_meshes_of_a_urdf_are_found_beside_it_and_by_ros_addresses(tmp_path, address):
    for name in ("meshes", "urdf"):
        (tmp_path / "arms" / name).mkdir(parents=True)
    write_box(tmp_path / "arms" / "meshes" / "block.obj")
    robot = write_robot(tmp_path / "arms" / "urdf", with_mesh(address), URDF_DESCRIPTION)
    with WorldBatch(world_of(robot), 1) as worlds:
        assert worlds.model.nmesh == 1
        assert worlds.model.mesh_vertnum[0] == 8


def test_an_arm_of_a_urdf_picks_and_places(sixer):
    placement = place_in_air(load_config(RECIPE, [f"world.robot={sixer}"]).world, 12, seed=0)
    held = (placement.distance_m < 0.01) & (placement.distance_after_hold_m < 0.01) & (placement.slip_m <= 0.005)
    assert held.mean() >= 0.95
    assert placement.grasped.mean() >= 0.95


def test_only_the_gripper_touches_and_nothing_of_a_scene_comes_along(pincher):
    with WorldBatch(world_of(pincher), 1) as worlds:
        model = worlds.model
        touching = {model.geom(index).name for index in range(model.ngeom) if model.geom_contype[index] == GRIPPER_BIT}
        assert touching == {"robot/fixed", "robot/moving"}
        fixed = model.geom("robot/fixed")
        assert (fixed.friction.tolist(), fixed.solref[0], fixed.priority[0]) == ([0.3, 0.005, 0.0001], 0.01, 2)
        assert model.body("robot/base").pos.tolist() == [-0.36, 0.0, 0.0]
        assert (model.opt.timestep, model.opt.gravity[2]) == (0.002, 0.0)
        assert (model.nu, model.nkey, model.nlight, model.nsensor) == (7, 0, 0, 1)
        assert mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM, "robot/floor") == -1
        np.testing.assert_array_equal(model.dof_armature[:6], [0.3] * 5 + [0.3])


def test_pads_touch_instead_of_a_fingers_own_shapes(tmp_path):
    pad = {"start_m": [0.0, 0.0, 0.03], "end_m": [0.0, 0.0, 0.1], "radius_m": 0.006}
    robot = write_robot(tmp_path, fingers=[{"joint": "jaw", "closed": 0.0, "open": 0.07, "pads": [pad, pad]}])
    with WorldBatch(world_of(robot), 1) as worlds:
        model = worlds.model
        solid = [model.geom(index) for index in range(model.ngeom) if model.geom_contype[index] == GRIPPER_BIT]
        assert [geom.type[0] for geom in solid if geom.name != "robot/fixed"] == [mujoco.mjtGeom.mjGEOM_CAPSULE] * 2


def test_a_finger_that_touches_nothing_is_refused(tmp_path):
    before, name, after = URDF.partition('<link name="left_finger">')
    shape, end, rest = after.partition("</link>")
    shapeless = before + name + shape[: shape.index("<collision>")] + end + rest
    with pytest.raises(ConfigError, match=r"finger 'left' has no shape that touches anything: give it pads"):
        WorldBatch(world_of(write_robot(tmp_path, shapeless, URDF_DESCRIPTION)), 1)


def test_a_description_is_part_of_the_configuration(pincher, tmp_path, monkeypatch):
    config = load_config(None, [f"world.robot={pincher}"])
    (tmp_path / "saved.yaml").write_text(dump_config(config))
    pincher.unlink()  # what was read once is not needed again
    monkeypatch.chdir("/")
    assert load_config(tmp_path / "saved.yaml") == config
    assert config.world.robot.model == str(tmp_path / "pincher.xml")
    assert load_config().world.robot == "panda"


def test_a_model_in_a_package(pincher, tmp_path, monkeypatch):
    package = tmp_path / "site" / "arms_of_mine"
    package.mkdir(parents=True)
    (package / "__init__.py").write_text("raise AssertionError('it need not be imported')")
    (package / "pincher.xml").write_text(PINCHER)
    monkeypatch.syspath_prepend(tmp_path / "site")
    with WorldBatch(world_of(write_robot(tmp_path)), 1) as worlds:
        plain = worlds.ee_position.copy()
    robot = tmp_path / "packaged.yaml"
    robot.write_text(pincher.read_text().replace("model: pincher.xml", "model: package:arms_of_mine/pincher.xml"))
    with WorldBatch(world_of(robot), 1) as worlds:
        np.testing.assert_array_equal(worlds.ee_position, plain)
    robot.write_text(pincher.read_text().replace("model: pincher.xml", "model: package:nobody_has_it/pincher.xml"))
    with pytest.raises(ConfigError) as error:
        world_of(robot)
    assert_one_line(error.value, "no Python package 'nobody_has_it'")


def test_another_model_than_the_one_that_was_described_is_refused(pincher, tmp_path):
    world = world_of(pincher)
    (tmp_path / "pincher.xml").write_text(PINCHER.replace("-3 3", "-2 2"))
    with pytest.raises(ConfigError) as error:
        WorldBatch(world, 1)
    assert_one_line(error.value, "pincher.xml", "is not the one", "sha256")


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"model": "none.xml"}, ["none.xml", "No such file"]),
        ({"model": None}, ["model is missing"]),
        (
            {"joints": ["yaw", "lift", "elbow", "bend"], "home": [0.0] * 4},
            ["yaw, lift, elbow, bend, roll, jaw", "weld"],
        ),
        ({"joints": ["yaw", "lift", "elbow", "bend", "twist"]}, ["no joint 'twist', only yaw, lift"]),
        ({"joints": ["lift", "yaw", "elbow", "bend", "roll"]}, ["in their order, yaw, lift, elbow"]),
        ({"joints": ["yaw", "yaw", "elbow", "bend", "roll"]}, ["'yaw' is named twice"]),
        ({"home": [0.0, 0.3, 1.5]}, ["home has 3 numbers, there are 5 joints"]),
        ({"stiffness": [1.0, 2.0]}, ["stiffness has 2 numbers, there are 5 joints"]),
        ({"finger_damping": [1.0, 2.0]}, ["finger_damping has 2 numbers, there are 1 fingers"]),
        ({"effector": {"frame": "nose"}}, ["no site or body 'nose'"]),
        ({"fingers": [{"joint": "jaw", "closed": 0.0, "open": 0.0}]}, ["closed and open are both 0"]),
        ({"opening_m": 0.04}, ["opens to 0.04 m", "0.05 m wide"]),
        ({"touching": ["ear"]}, ["no body 'ear'", "touching"]),
        ({"root": "plinth"}, ["no body 'plinth'"]),
        ({"base_position_m": [-1.5, 0.0, 0.0]}, ["100% of the workspace is out of its reach", "base_position_m"]),
        ({"home": [0.0, 0.3, 0.0, 0.0, 0.0]}, ["home posture", "check home, effector and orientation"]),
        ({"home": [0.0, 0.0, 0.0, 0.0, 0.0]}, ["on the axis of its base", "bend the arm"]),
        ({"fingers": [{"joint": "jaw", "closed": 0.0, "open": 5.0}]}, ["open at 5", "its joint goes from"]),
        ({"stiffness": -1.0}, ["stiffness", "greater than or equal to 0"]),
        ({"effector": {"frame": "nose", "quaternion": [0, 0, 0, 0]}}, ["quaternion: all four numbers are 0"]),
        ({"hand": {"model": "hand.xml", "at": "elbow"}}, ["no site or body 'elbow'"]),
        ({"wheels": 4}, ["unknown key 'wheels'"]),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else "",
)
def test_mistakes_in_a_description_are_one_line(tmp_path, changed, said):
    robot = write_robot(tmp_path, **changed)
    with pytest.raises(ConfigError) as error:
        WorldBatch(world_of(robot), 1)
    assert_one_line(error.value, "pincher", *said)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('range="-.5 .3"', 'range="-.1 .3"', ["57% of the workspace is out of its reach", "base_position_m"]),
        ('axis="1 0 0" range="-.5 .5"', 'axis="1 0 0" range="-.06 .06"', ["of the workspace is out of its reach"]),
        ('range="-.5 .3"', 'range="-.5 -.1"', ["home of 'z' is 0", "the joint goes from"]),
    ],
)
def test_a_gantry_has_to_reach_the_workspace_from_home(tmp_path, old, new, said):
    assert old in GANTRY
    robot = write_robot(tmp_path, GANTRY.replace(old, new), GANTRY_DESCRIPTION)
    with pytest.raises(ConfigError) as error:
        WorldBatch(world_of(robot), 1)
    assert_one_line(error.value, "gantry", *said)


TURNS, ROLLS_FREELY = '<joint name="roll" axis="0 0 1" range="-3 3"/>', '<joint name="roll" type="ball"/>'


@pytest.mark.parametrize(
    ("model", "said"),
    [
        ("<mujoco", ["MuJoCo cannot read it"]),
        (PINCHER.replace(TURNS, ROLLS_FREELY), ["hinge"]),
        (PINCHER.replace("</worldbody>", '<body name="cup"/></worldbody>'), ["2 bodies at its top", "base, cup"]),
        ("<robot name='sixer'><link name='base'/>", ["MuJoCo cannot read it"]),
        (URDF.replace('<child link="tool"/>', '<child link="tools"/>'), ["sixer.urdf", "MuJoCo cannot read it"]),
        (with_mesh("a.stl"), ["a.stl", "MuJoCo cannot build it"]),
        (with_mesh("package://arms/a.stl"), ["a.stl", "ROS package 'arms'", "no directory above"]),
    ],
    ids=["no XML", "a ball joint", "two roots", "cut off", "no such link", "no such mesh", "no such package"],
)
def test_models_that_do_not_fit_are_one_line(tmp_path, model, said):
    description = URDF_DESCRIPTION if "<robot" in model else PINCHER_DESCRIPTION
    with pytest.raises(ConfigError) as error:
        WorldBatch(world_of(write_robot(tmp_path, model, description)), 1)
    assert_one_line(error.value, description["name"], *said)


@pytest.mark.parametrize(
    ("robot", "package", "kept"),
    [("viperx", "gym_aloha", 0.95), ("jaco", "dm_control", 0.95), ("ur5e", "robosuite", 0.95)],
    ids=lambda value: value,
)
def test_arms_that_nobody_here_drew_pick_and_place(robot, package, kept):
    if find_spec(package) is None:
        pytest.skip(f"needs its model: pip install --no-deps {package.replace('_', '-')}")
    world = load_config(RECIPE, [f"world.robot={ROBOTS / robot}.yaml", "world.workspace.height_m=0.25"]).world
    placement = place_in_air(world, 100, seed=0)
    held = (placement.distance_m < 0.01) & (placement.distance_after_hold_m < 0.01) & (placement.slip_m <= 0.005)
    assert held.mean() >= kept
