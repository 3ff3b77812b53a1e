"""What is measured, against players whose motion is known."""

import numpy as np
import pytest

from service.actors.evaluation import IdlePolicy
from service.config import RunConfig, WorldConfig
from service.config.world import ObservedConfig
from service.envs.observations import ACTION, layouts
from service.export.measurements import measure, measure_response, tolerated_late_steps
from service.registry.loading import Trained
from tests.export.policies import CONFIG, SEEN, WORLD


class Upwards:
    """Goes up at full speed, and keeps what it saw."""

    def __init__(self, seen):
        self._seen = seen

    def begin(self):
        self._seen.append([])

    def act_deterministic(self, observation):
        self._seen[-1].append(observation.copy())
        action = np.zeros((len(observation), ACTION.size), dtype=np.float32)
        action[:, 2] = 1.0
        return action


def trained(policy, world=WORLD, num_steps=5):
    config = CONFIG.model_copy(update={"world": world, "run": RunConfig(evaluation_steps=num_steps)})
    return Trained("made", "primitives", config, policy, {})


def test_late_positions_and_the_speed_of_the_tip():
    seen = []
    measured, observations = measure(trained(Upwards(seen)), 3)
    assert observations.shape == (6, 3, SEEN.bob.size)
    on_time = np.array(seen[0])
    np.testing.assert_array_equal(on_time, observations[:-1])
    commands = slice(11, 19)  # the last two commands, which a policy knows at once
    places = [column for column in range(SEEN.bob.size) if column not in range(11, 19)]
    for steps in (1, 2):
        late = np.array(seen[steps])
        np.testing.assert_array_equal(late[:, :, commands], on_time[:, :, commands])
        np.testing.assert_array_equal(late[steps:][:, :, places], on_time[:-steps][:, :, places])
        np.testing.assert_array_equal(late[0], on_time[0])
    motion = measured["motion"]
    velocity = np.diff(observations[:, :, :3].astype(float), axis=0) / 0.04
    speed = np.linalg.norm(velocity, axis=2)
    assert motion["tip_speed_m_s"]["max"] == pytest.approx(speed.max(), rel=1e-3)
    assert motion["tip_speed_m_s"]["median"] == pytest.approx(np.median(speed), rel=1e-3)
    acceleration = np.linalg.norm(np.diff(velocity, axis=0), axis=2) / 0.04
    assert motion["tip_acceleration_m_s2"]["max"] == pytest.approx(acceleration.max(), rel=1e-3)
    assert motion["num_episodes"] == 3


def test_a_policy_that_observes_its_delay_is_told_it():
    world, seen = WORLD.model_copy(update={"observed": ObservedConfig(num_commands=1, delay=True)}), []
    measure(trained(Upwards(seen), world, 3), 2)
    delay = layouts(world).bob["delay"]
    assert [np.unique(np.array(each)[:, :, delay]).tolist() for each in seen] == [[0.0], [1.0], [2.0]]


def test_who_stands_still():
    measured, _ = measure(trained(IdlePolicy()), 3)
    assert measured["motion"]["tip_speed_m_s"]["max"] < 0.01
    assert measured["motion"]["outside_workspace"] == 0.0
    assert tolerated_late_steps(measured) == 2


@pytest.mark.parametrize(("rates", "tolerated"), [((0.9, 0.85, 0.5), 1), ((0.9, 0.5, 0.9), 0), ((0.9, 0.8, 0.8), 2)])
def test_tolerated_delay(rates, tolerated):
    assert tolerated_late_steps({"late_observations": [{"success_last": rate} for rate in rates]}) == tolerated


def test_the_arm_covers_a_part_of_a_full_action():
    """56 to 61 % in motion, less from rest; the gripper nearly all of its way."""
    measured = measure_response(WORLD)
    assert [(each["axis"], each["direction"]) for each in measured["response"]] == [
        (axis, direction) for axis in "xyz" for direction in (1, -1)
    ]
    for each in measured["response"]:
        assert 0.56 < each["moving_mean"] < 0.62
        assert each["from_rest_mean"] < each["moving_mean"]
        assert 0.0 < each["moving_std"] < 0.03
    assert [each["direction"] for each in measured["width_response"]] == [1, -1]
    for each in measured["width_response"]:
        assert each["asked_m"] == 0.08
        assert 0.06 < each["covered_m"] < 0.08


def test_obstacles_are_not_in_the_arms_way():
    tall = {"shape": "box", "size_m": (0.06, 0.06, 0.25), "mass_kg": 1.0}
    obstructed = WorldConfig.model_validate(
        WORLD.model_dump() | {"obstacles": [tall] * 3, "observed": {"num_commands": 2, "obstacles": True}}
    )
    assert measure_response(obstructed) == measure_response(WORLD)


def test_a_gripper_that_is_held_closed_covers_nothing():
    widths = measure_response(WORLD.model_copy(update={"gripper": "blocked"}))["width_response"]
    assert [each["asked_m"] for each in widths] == [0.0, 0.0]
