"""Four tasks for primitives of a world of two cubes: the first one is red, the second one blue.

tandem train docs/examples/two_cubes.py:STACK --primitives panda-two-cubes@champion --method ours-her
"""

import numpy as np

from tandem_skills import Task

EDGE_M, NEAR_M = 0.05, 0.04
STILL_M_S = 0.05
WORLD = {"objects": ["cube", "cube"]}


def red_to(goal, s):
    """Goals for both: red goes to (N, 3), and blue is to stay."""
    return np.stack([goal, s.objects[:, 1].place], axis=1)


def red_is_there(s, within_m=NEAR_M):
    return np.linalg.norm(s.objects[:, 0].place - s.goal[:, 0], axis=1) < within_m


def on_blue(s, rng):
    return red_to(s.objects[:, 1].place + [0.0, 0.0, EDGE_M], s)


def stacked(s):
    above = s.objects[:, 0].place - s.objects[:, 1].place
    in_line = (np.abs(above[:, 2] - EDGE_M) < 0.01) & (np.linalg.norm(above[:, :2], axis=1) < 0.025)
    still = np.linalg.norm(s.objects.velocity, axis=2).max(axis=1) < STILL_M_S
    return in_line & still & ~s.contacts[:, 0].any(axis=1)


def both_there_and_let_go(s):  # half of it while a finger touches red
    near = np.linalg.norm(s.objects.place - s.goal, axis=2).max(axis=1) < 0.025
    return near * np.where(s.contacts[:, 0].any(axis=1), 0.5, 1.0)


STACK = Task(
    title="Stack",
    description="red on blue, let go of, and still",
    world=WORLD,
    goals=on_blue,
    success=stacked,
    reward=both_there_and_let_go,
    episode_steps=100,
)


def beside_blue(s, rng):
    way = rng.uniform(0.0, 2 * np.pi, len(s.elapsed))
    distance = rng.uniform(0.08, 0.2, len(way))
    beside = np.stack([np.cos(way) * distance, np.sin(way) * distance, np.zeros(len(way))], axis=1)
    return red_to(s.objects[:, 1].place + beside, s)


UNSTACK = Task(
    title="Unstack",
    description="red from blue to the table beside it",
    world=WORLD | {"start_height_m": 0.15},  # above both
    starts=on_blue,
    goals=beside_blue,
    episode_steps=100,
)


def left_and_right(s, rng):
    place = rng.uniform([-0.2, 0.05, 0.0], [0.1, 0.17, 0.0], s.objects.place.shape)
    return place * np.array([[1.0, 1.0, 0.0], [1.0, -1.0, 0.0]]) + [0.0, 0.0, EDGE_M / 2]


SORT = Task(
    title="Sort",
    description="red to the left, blue to the right",
    world=WORLD,
    goals=left_and_right,
    episode_steps=100,
)


def side_by_side(s, rng):  # no finger fits between them
    blue = s.objects[:, 1].place
    side = rng.choice([-1.0, 1.0], len(blue))
    gap = EDGE_M + rng.uniform(0.002, 0.01, len(blue))
    return red_to(blue + np.stack([np.zeros(len(blue)), side * gap, np.zeros(len(blue))], axis=1), s)


def red_in_the_air(s, rng):
    return red_to(rng.uniform([-0.2, -0.15, 0.1], [0.1, 0.15, 0.25], (len(s.elapsed), 3)), s)


CLEAR = Task(
    title="Clear",
    description="red up from beside blue, which is in the way of a finger; where blue goes does not matter",
    world=WORLD,
    starts=side_by_side,
    goals=red_in_the_air,
    success=lambda s: red_is_there(s, 0.05),
    reward=lambda s: red_is_there(s).astype(float),
    episode_steps=100,
)
