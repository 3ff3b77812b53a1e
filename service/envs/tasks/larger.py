"""Larger: a larger workspace."""

from service.envs.task import Task

TASK = Task(
    "Larger",
    "objects and goals in a larger workspace, 45 x 45 x 40 cm",
    "mixed",
    {"workspace": {"length_x_m": 0.45, "length_y_m": 0.45, "height_m": 0.40}},
)
