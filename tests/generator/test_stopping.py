"""A run stops only when both hold: nothing new, all solved."""

from __future__ import annotations

import pytest

from service.config.self_play import GeneratorConfig
from service.generator.generator import StopCriterion

CONFIG = GeneratorConfig(novelty_window=4, stop_success_rate=0.95)


def after(*iterations: tuple[int, int, int]) -> StopCriterion:
    stop = StopCriterion(CONFIG)
    for num_new_cells, num_tried, num_solved in iterations:
        stop.record(num_new_cells, num_tried, num_solved)
    return stop


@pytest.mark.parametrize(
    ("iterations", "expected"),
    [
        ([(0, 40, 38)] * 4, True),  # 152 of 160 is exactly 95 %
        ([(0, 40, 38)] * 3 + [(0, 40, 37)], False),
        ([(0, 40, 40)] * 3, False),  # the window is not full
        ([(0, 40, 40)] * 3 + [(1, 40, 40)], False),  # something new at the end
        ([(1, 40, 40)] + [(0, 40, 40)] * 3, False),  # something new at the start of the window
        ([(9, 40, 0)] + [(0, 40, 40)] * 4, True),  # both the novelty and the failures lie before the window
        ([(0, 24, 24)] * 4, False),  # 96 goals are too few
        ([(0, 25, 25)] * 4, True),
        ([(0, 0, 0)] * 9, False),  # an Alice who never proposes does not end the run
        ([], False),
    ],
)
def test_should_stop(iterations: list[tuple[int, int, int]], expected: bool) -> None:
    assert after(*iterations).should_stop() is expected


def test_iterations_without_new_cell() -> None:
    assert after((3, 1, 1), (0, 1, 1), (0, 1, 1)).num_iterations_without_new_cell == 2
    assert after((0, 1, 1), (2, 1, 1)).num_iterations_without_new_cell == 0


def test_state_round_trip_continues_the_window() -> None:
    stop, copy = after((1, 40, 0), (0, 40, 40), (0, 40, 40)), StopCriterion(CONFIG)
    copy.load_state(stop.state())
    decisions: list[list[bool]] = []
    for criterion in (stop, copy):
        decisions.append([])
        for _ in range(3):
            criterion.record(0, 40, 40)
            decisions[-1].append(criterion.should_stop())
    assert decisions == [[False, True, True]] * 2
