"""Each verdict, its boundary, and their order."""

from __future__ import annotations

import numpy as np
import pytest

from service.config import WorkspaceConfig
from service.generator.validity import Verdict, classify_goal, in_workspace

# Lengths and centres that are exact in binary, so a boundary is a boundary.
BOX = WorkspaceConfig(center_x_m=0.0, center_y_m=0.0, length_x_m=0.5, length_y_m=0.5, height_m=0.375)
OFF_CENTRE = WorkspaceConfig(center_x_m=-0.125, center_y_m=0.25, length_x_m=0.25, length_y_m=0.5, height_m=0.25)
NAN = float("nan")


def classify_one(
    end: tuple[float, ...], start: tuple[float, ...] = (0.0, 0.0, 0.0), box: WorkspaceConfig = BOX
) -> Verdict:
    return Verdict(classify_goal(np.array([start]), np.array([end]), box, 0.0625)[0])


@pytest.mark.parametrize(
    ("end", "verdict"),
    [
        ((0.125, 0.0, 0.0), Verdict.VALID),
        ((0.0625, 0.0, 0.0), Verdict.NOT_MOVED),  # exactly the success distance: Bob would have solved it at the start
        ((0.0626, 0.0, 0.0), Verdict.VALID),
        ((0.0, 0.0, 0.0), Verdict.NOT_MOVED),
        ((0.0, 0.0, 0.07), Verdict.VALID),  # moved straight up counts
        ((0.25, 0.25, 0.375), Verdict.VALID),  # the faces belong to the box
        ((-0.25, -0.25, 0.0), Verdict.VALID),
        ((0.2501, 0.0, 0.1), Verdict.OUTSIDE),
        ((0.0, -0.2501, 0.1), Verdict.OUTSIDE),
        ((0.0, 0.0, 0.3751), Verdict.OUTSIDE),
        ((0.125, 0.0, -0.001), Verdict.OUTSIDE),
        ((0.125, 0.0, -0.02), Verdict.OUTSIDE),  # the last height that is not fallen
        ((0.125, 0.0, -0.0201), Verdict.FALLEN),
        ((9.0, 0.0, -0.7), Verdict.FALLEN),  # also outside: fallen is the reason
        ((0.0, 0.0, -0.03), Verdict.FALLEN),  # also not moved
        ((NAN, 0.0, 0.1), Verdict.FALLEN),
        ((0.125, 0.0, NAN), Verdict.FALLEN),
        ((float("inf"), 0.0, 0.1), Verdict.FALLEN),
    ],
)
def test_verdict(end: tuple[float, ...], verdict: Verdict) -> None:
    assert classify_one(end) == verdict


def test_not_moved_comes_before_outside() -> None:
    assert classify_one((0.5, 0.0, 0.1), start=(0.5, 0.03, 0.1)) == Verdict.NOT_MOVED


def test_a_start_that_is_not_finite_gives_no_valid_goal() -> None:
    assert classify_one((0.125, 0.0, 0.0), start=(NAN, 0.0, 0.0)) == Verdict.NOT_MOVED


def test_every_world_gets_its_own() -> None:
    end = np.array([[0.125, 0.0, 0.1], [0.0, 0.0, 0.0], [0.5, 0.0, 0.1], [0.0, 0.0, -1.0]])
    verdicts = classify_goal(np.zeros((4, 3)), end, BOX, 0.0625)
    assert verdicts.dtype == np.int8
    assert verdicts.tolist() == [Verdict.VALID, Verdict.NOT_MOVED, Verdict.OUTSIDE, Verdict.FALLEN]


def test_numbers_of_verdicts_are_stable() -> None:
    assert {verdict.name: int(verdict) for verdict in Verdict} == {
        "VALID": 0,
        "NOT_MOVED": 1,
        "OUTSIDE": 2,
        "FALLEN": 3,
    }


def test_workspace_off_centre() -> None:
    position = np.array(
        [[-0.25, 0.0, 0.0], [0.0, 0.5, 0.25], [0.001, 0.25, 0.1], [-0.125, -0.001, 0.1], [-0.251, 0.25, 0.1]]
    )
    assert in_workspace(position, OFF_CENTRE).tolist() == [True, True, False, False, False]
    assert classify_one((0.1, 0.1, 0.1), box=OFF_CENTRE) == Verdict.OUTSIDE
    assert classify_one((-0.1, 0.1, 0.1), box=OFF_CENTRE) == Verdict.VALID
