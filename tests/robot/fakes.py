"""A robot and a tracker whose every fault is at hand, with a clock that only they move."""

import threading

import numpy as np

from service.base.errors import RobotError
from service.robot.interface import Command, ObjectPose, RobotState

HOME_M = np.array([-0.05, 0.0, 0.1])
OBJECT_M = np.array([0.0, 0.05, 0.025])


class FakeRobot:
    """Follows its set-points with a lag of first order; ``fault`` names what is wrong from ``fault_s`` on."""

    def __init__(self, lag_s=0.0, jitter_s=0.0, rng=None, read_s=0.0):
        self.read_s = read_s
        self.time_s, self.lag_s, self.jitter_s, self.rng = 0.0, lag_s, jitter_s, rng
        self.effector_m, self.fingers_m, self.set_point_m = HOME_M.copy(), np.array([0.04, 0.04]), HOME_M.copy()
        self.commands: list[tuple[float, Command]] = []
        self.stops: list[float] = []
        self.fault, self.fault_s = "", np.inf
        self.stopped = threading.Event()
        self.poses = FakePoses(self)

    def has(self, fault):
        return self.fault == fault and self.time_s >= self.fault_s

    def now_s(self):
        return self.time_s

    def advance(self, duration_s):
        share = 1.0 if self.lag_s == 0.0 else 1.0 - np.exp(-duration_s / self.lag_s)
        self.effector_m = self.effector_m + share * (self.set_point_m - self.effector_m)
        self.time_s += duration_s

    def read(self):
        if self.has("read fails"):
            raise RobotError("no answer")
        self.time_s += 0.06 if self.has("slow read") else self.read_s
        time_s = self.fault_s if self.has("stale state") else self.time_s
        effector = np.full(3, np.nan) if self.has("lost joints") else self.effector_m.copy()
        return RobotState(time_s, effector, self.fingers_m.copy(), connected=not self.has("disconnected"))

    def command(self, command):
        if self.has("command fails"):
            raise RobotError("refused")
        self.commands.append((self.time_s, command))
        self.set_point_m = command.effector_m

    def wait_until(self, time_s):
        late_s = 0.06 if self.has("late") else 0.0 if self.rng is None else self.rng.uniform(0.0, self.jitter_s)
        if time_s + late_s > self.time_s:
            self.advance(time_s + late_s - self.time_s)

    def stop(self):
        self.stops.append(self.time_s)
        self.stopped.set()

    def close(self):
        pass


class FakePoses:
    def __init__(self, robot):
        self.robot, self.position_m = robot, OBJECT_M.copy()

    def read(self):
        robot, place = self.robot, self.position_m
        now_s, fault_s = robot.time_s, robot.fault_s
        if now_s < fault_s:
            return ObjectPose(now_s, place)
        wrong = {
            "frozen pose": ObjectPose(fault_s, place),
            "ageing pose": ObjectPose(fault_s + 0.1 * (now_s - fault_s), place),
            "unseen": ObjectPose(now_s, np.full(3, np.nan)),
            "jumping pose": ObjectPose(now_s, place + np.array([0.0, 0.3, 0.0])),
            "early pose": ObjectPose(now_s + 5.0, place),
            "no pose": None,
        }
        return wrong.get(robot.fault, ObjectPose(now_s, place))

    def close(self):
        pass


class Steady:
    """A policy of one action."""

    def __init__(self, action):
        self.action = np.array([action], dtype=np.float32)

    def act_deterministic(self, observation):
        return self.action
