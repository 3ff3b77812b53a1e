import os
import time

import numpy as np
import pytest

from service.base.errors import TandemError
from service.robot import watchdogs
from service.robot.interface import ObjectPose, RobotState


def test_a_key_counts_while_it_repeats(monkeypatch):
    clock = [100.0]
    monkeypatch.setattr(watchdogs.time, "monotonic", lambda: clock[0])
    ours, theirs = os.openpty()
    try:
        with watchdogs.HeldKey(theirs) as held:
            assert not held()
            for _ in range(5):
                os.write(ours, b" ")
                clock[0] += 0.05
                while not held():  # until the terminal has handed it on
                    time.sleep(0.001)
            clock[0] += 0.2
            assert not held()
            steps = iter([*[b" "] * 10, b"", *[b" "] * 60])

            def press(seconds):
                os.write(ours, next(steps))
                clock[0] += 0.05

            monkeypatch.setattr(watchdogs.time, "sleep", press)
            before_s = clock[0]
            held.wait()
            assert clock[0] - before_s >= 1.0
    finally:
        os.close(ours)
        os.close(theirs)


def test_without_a_terminal_there_is_no_key():
    reading, writing = os.pipe()
    with pytest.raises(TandemError, match="no terminal: run in one"):
        watchdogs.HeldKey(reading)
    os.close(reading)
    os.close(writing)


def test_each_of_two_objects_is_watched():
    """3 m/s and 5 cm are allowed in 40 ms: 17 cm, of either."""
    first, second = np.array([0.0, 0.1, 0.025]), np.array([0.1, 0.0, 0.025])

    def seen(place, other):
        watch = watchdogs.PoseWatch(watchdogs.WatchConfig(), 2)
        assert watch.check(ObjectPose(0.0, np.concatenate((first, second))), 0.0) is None
        assert watch.check(ObjectPose(0.04, np.concatenate((place, other))), 0.04) is None  # one may still stand in
        return watch.position_m

    near, far = np.array([0.16, 0.0, 0.0]), np.array([0.18, 0.0, 0.0])
    np.testing.assert_array_equal(seen(first + near, second + near), [*(first + near), *(second + near)])
    np.testing.assert_array_equal(seen(first, second + far), [*first, *second])
    np.testing.assert_array_equal(seen(first + far, second), [*first, *second])
    np.testing.assert_array_equal(seen(first + near, np.full(3, np.nan)), [*first, *second])
    watch = watchdogs.PoseWatch(watchdogs.WatchConfig(), 2)
    assert watch.check(ObjectPose(0.0, [*first, None, None, None]), 0.0) == "object 2 is not seen"
    fault = watchdogs.PoseWatch(watchdogs.WatchConfig(), 2).check(ObjectPose(0.0, first), 0.0)
    assert fault == "an object pose of the shape (3,), not (6,): x, y, z, x, y, z"


@pytest.mark.parametrize(
    ("time_s", "now_s", "fault"),
    [
        (1.0, 1.099, None),
        (1.0, 1.12, "the robot's state is 120 ms old"),
        (1.019, 1.0, None),
        (1.03, 1.0, "the robot's state is of 30 ms in the future"),
    ],
)
def test_the_age_of_a_state(time_s, now_s, fault):
    state = RobotState(time_s, np.zeros(3), np.zeros(2))
    assert watchdogs.StateWatch(watchdogs.WatchConfig()).check(state, now_s) == fault


def test_a_state_of_another_shape_is_a_fault():
    state = RobotState(1.0, np.zeros(3), np.array([0.08]))
    fault = watchdogs.StateWatch(watchdogs.WatchConfig()).check(state, 1.0)
    assert fault == "in the robot's state effector_m has the shape (3,) and fingers_m (1,): give (3,), (2,)"


def test_a_state_whose_time_is_no_number_is_a_fault():
    state = RobotState(float("nan"), np.zeros(3), np.zeros(2))
    assert "ms old" in watchdogs.StateWatch(watchdogs.WatchConfig()).check(state, 1.0)
