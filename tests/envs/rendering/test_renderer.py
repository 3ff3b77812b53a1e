import os
import subprocess
import sys

import numpy as np
import pytest

from service.base.errors import TandemError
from service.config import WorldConfig
from service.envs.batch import WorldBatch
from service.envs.rendering.decoration import decorate
from service.envs.rendering.gl import open_drawing
from service.envs.rendering.renderer import SceneRenderer
from service.envs.scene import build_spec

WIDTH, HEIGHT = 200, 150
GOAL = np.array([0.05, -0.12, 0.28])

BROKEN = """
from service.envs.rendering import gl
gl.protect_import()
from service.config import WorldConfig
from service.envs.batch import WorldBatch
import numpy as np
with WorldBatch(WorldConfig(), 1, num_threads=1) as worlds:
    worlds.step(np.zeros((1, 4), dtype=np.float32))
from service.base.errors import TandemError
from service.envs.rendering.renderer import SceneRenderer
try:
    SceneRenderer(WorldConfig(), 32, 32)
except TandemError as error:
    print(error)
"""


def open_renderer(config=None, **options):
    try:
        return SceneRenderer(config or WorldConfig(), WIDTH, HEIGHT, **options)
    except TandemError as error:
        if not str(error).startswith("cannot draw"):
            raise
        pytest.skip(str(error))


@pytest.fixture(scope="module")
def renderer():
    with open_renderer() as renderer:
        yield renderer


def state_with_object_at(*position, config=None):
    """(S,) the arm at home, the object somewhere."""
    with WorldBatch(config or WorldConfig(), 1, num_threads=1) as worlds:
        worlds.object_position[:] = position
        return worlds.states[0].copy()


def project(position, camera, model):
    """(column, row) of a point, by the pinhole model: forward from azimuth and elevation, z up."""
    azimuth, elevation = np.radians([camera.azimuth, camera.elevation])
    forward = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    right = np.array([np.sin(azimuth), -np.cos(azimuth), 0.0])
    offset = np.asarray(position) - (np.asarray(camera.lookat) - camera.distance * forward)
    focal = HEIGHT / 2 / np.tan(np.radians(model.vis.global_.fovy) / 2)
    depth = offset @ forward
    return WIDTH / 2 + focal * (offset @ right) / depth, HEIGHT / 2 - focal * (
        offset @ np.cross(right, forward)
    ) / depth


def red(image):
    """(H, W) where a pixel is as red as the object, and no wood."""
    image = image.astype(int)
    return (image[..., 0] > 80) & (image[..., 0] > 2.2 * image[..., 1]) & (image[..., 0] > 2.2 * image[..., 2])


def middle(mask):
    rows, columns = np.nonzero(mask)
    return columns.mean(), rows.mean()


def test_decoration_collides_with_nothing_and_weighs_nothing():
    config = WorldConfig()
    physics = build_spec(config).compile()
    spec = build_spec(config)
    decorate(spec, config)
    picture = spec.compile()
    assert picture.ngeom > physics.ngeom + 40
    touches = (picture.geom_contype != 0) | (picture.geom_conaffinity != 0)
    assert touches.sum() == ((physics.geom_contype != 0) | (physics.geom_conaffinity != 0)).sum()
    np.testing.assert_array_equal(picture.body_mass, physics.body_mass)
    np.testing.assert_array_equal(picture.body_inertia, physics.body_inertia)
    assert (picture.nq, picture.nv, picture.na, picture.nu) == (physics.nq, physics.nv, physics.na, physics.nu)
    np.testing.assert_array_equal(picture.jnt_qposadr, physics.jnt_qposadr)


@pytest.mark.parametrize("position", [(0.08, -0.1, 0.025), (0.05, 0.12, 0.2)])
def test_the_object_is_red_and_where_it_should_be(renderer, position):
    image = renderer.render(state_with_object_at(*position))
    assert image.shape == (HEIGHT, WIDTH, 3)
    assert image.dtype == np.uint8
    mask = red(image)
    # A 5 cm cube is 2.9 times its focal length over its distance: about 7 pixels a side here.
    assert 25 < mask.sum() < 150
    assert middle(mask) == pytest.approx(project(position, renderer.camera, renderer.model), abs=2.0)


def test_the_goal_is_a_ghost_where_it_should_be(renderer):
    state = state_with_object_at(0.1, 0.1, 0.025)
    without, with_goal = renderer.render(state), renderer.render(state, GOAL)
    changed = np.abs(with_goal.astype(int) - without).max(axis=2) > 12
    column, row = project(GOAL, renderer.camera, renderer.model)
    _, foot_row = project((*GOAL[:2], 0.0), renderer.camera, renderer.model)
    assert changed[round(row) - 2 : round(row) + 3, round(column) - 2 : round(column) + 3].all()
    rows, columns = np.nonzero(changed)
    assert np.abs(columns - column).max() < 9
    assert row - 9 < rows.min()
    assert rows.max() < foot_row + 5
    # Transparent: what is behind still tells, so the ghost is paler than the object.
    assert with_goal[round(row), round(column), 1] > 1.3 * renderer.render(state)[red(without)][:, 1].mean()


def test_a_sphere_is_round():
    config = WorldConfig(object="sphere", object_size_m=0.07)
    with open_renderer(config) as renderer:
        mask = red(renderer.render(state_with_object_at(0.1, -0.1, 0.2, config=config)))
    rows, columns = np.nonzero(mask)
    height, width = np.ptp(rows) + 1, np.ptp(columns) + 1
    assert abs(height - width) <= 2
    assert mask.sum() == pytest.approx(np.pi / 4 * height * width, rel=0.15)


def test_a_goal_is_drawn_however_many_pieces_a_world_has():
    shelf = WorldConfig(fixtures=({"shape": "box", "size_m": (0.05, 0.05, 0.05), "position_m": (0.1, 0.3)},))
    config = shelf.model_copy(update={"fixtures": shelf.fixtures * 250})
    state = state_with_object_at(0.1, 0.1, 0.025)
    with open_renderer(config) as renderer:
        without, with_goal = renderer.render(state), renderer.render(state, GOAL)
    column, row = map(round, project(GOAL, renderer.camera, renderer.model))
    assert (with_goal[row, column] != without[row, column]).any()


def test_the_flag_of_a_blocked_gripper_moves_no_box():
    """The flag of a blocked gripper stands behind the box's place in a state."""
    config = WorldConfig(fixture="box")
    pictures = []
    with open_renderer(config) as renderer:
        for blocked_fraction in (0.0, 0.5):
            with WorldBatch(config, 1, num_threads=1, blocked_fraction=blocked_fraction) as worlds:
                worlds.object_position[:], worlds.box_place[:] = [-0.9, 0.3, 0.025], [0.05, -0.12, 0.0]
                pictures.append(renderer.render(worlds.states[0]))
    np.testing.assert_array_equal(*pictures)


def test_closed_is_closed():
    renderer = open_renderer()
    renderer.close()
    renderer.close()
    with pytest.raises(AssertionError, match="after close"):
        renderer.render(state_with_object_at(0, 0, 0.025))


def test_rendering_that_is_turned_off(monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "disabled")
    with pytest.raises(TandemError, match="MUJOCO_GL=disabled turns rendering off; unset it"):
        open_drawing(build_spec(WorldConfig()).compile(), 32, 32)


def test_a_broken_choice_spoils_pictures_but_not_physics():
    environment = {**os.environ, "MUJOCO_GL": "nonsense"}
    result = subprocess.run(
        [sys.executable, "-c", BROKEN], env=environment, capture_output=True, text=True, timeout=600
    )
    assert result.returncode == 0, result.stderr
    (line,) = result.stdout.splitlines()
    assert "MUJOCO_GL=nonsense names no OpenGL that is here; unset it" in line
    assert "libosmesa6" in line
