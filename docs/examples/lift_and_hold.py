"""Lift the cube to its goal, and hold it there for two seconds."""

import numpy as np

from tandem_skills import Task


def there(s, within_m=0.05):
    return np.linalg.norm(s.objects[:, 0].place - s.goal[:, 0], axis=1) < within_m


def count(s):  # of steps in a row
    return np.where(there(s)[:, None], s.memory + 1, 0)


TASK = Task(
    title="Lift and hold",
    goals="air",
    success=lambda s: s.memory[:, 0] >= 50,  # of 40 ms: two seconds
    reward=lambda s: there(s, 0.04).astype(float),  # nearer, so it seldom leaves
    remember=count,
    memory_size=1,
    episode_steps=100,
)
