"""Views: what is typed for them, and that both kinds of cameras look from the same place."""

import mujoco
import numpy as np
import pytest

from service.base.errors import TandemError
from service.envs.rendering.camera import VIEWS, parse_view
from service.envs.rendering.renderer import goal_colors


def test_what_is_typed():
    assert parse_view("close") == VIEWS["close"]
    found = parse_view("side, elevation=-30,distance=2")
    assert (found.azimuth_deg, found.elevation_deg, found.distance_m) == (90.0, -30.0, 2.0)
    assert parse_view("azimuth=10").lookat_m == VIEWS["front"].lookat_m
    for wrong in ("", "moon", "close,zoom=3", "azimuth=left", "elevation=-91", "distance=inf", "close,side"):
        with pytest.raises(TandemError, match="camera"):
            parse_view(wrong)


@pytest.mark.parametrize("name", VIEWS)
def test_the_place_of_a_camera_is_mujocos(name):
    model = mujoco.MjSpec().compile()
    scene, data = mujoco.MjvScene(model, 10), mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    everything = mujoco.mjtCatBit.mjCAT_ALL
    mujoco.mjv_updateScene(model, data, mujoco.MjvOption(), None, VIEWS[name].camera(), everything, scene)
    eyes = np.mean([eye.pos for eye in scene.camera], axis=0)
    np.testing.assert_allclose(eyes, VIEWS[name].position_m, atol=1e-5)


def test_the_goal_of_a_green_object_is_not_green():
    (red,), (green,) = goal_colors([(0.8, 0.1, 0.1)]), goal_colors([(0.0, 0.7, 0.4)])
    assert red[1] > red[0]
    assert green[0] > green[1]
