"""Push the cube to the left without leaving a line: it must not stray from it by 3 cm on the way."""

import numpy as np

from tandem_skills import Task

LENGTH_M, STRAY_M = 0.15, 0.03


def goals(s, rng):
    return s.objects.place + [0.0, LENGTH_M, 0.0]


def strayed(s):  # once strayed, for ever
    away = np.abs(s.objects[:, 0].place[:, 0] - s.goal[:, 0, 0])
    return np.maximum(s.memory, (away > STRAY_M)[:, None])


def success(s):
    near = np.linalg.norm(s.objects[:, 0].place - s.goal[:, 0], axis=1) < 0.05
    return near & (s.memory[:, 0] == 0)


TASK = Task(
    title="Push along a line",
    description="15 cm to the left, never 3 cm off the line",
    goals=goals,
    world={"gripper": "blocked", "workspace": {"length_y_m": 0.45}},
    success=success,
    remember=strayed,
    memory_size=1,
)
