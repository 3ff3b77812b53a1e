"""The benchmark of a frozen policy in another engine: what it counts, a few real steps, its page, and wrong rows."""

import numpy as np
import pytest

from benchmarks import transfer
from benchmarks.transfer import (
    ROWS,
    Played,
    Settings,
    draw_episodes,
    inside_limits,
    play_chunk,
    summarise,
)
from benchmarks.transfer import policy_of as policy_of_row
from service.robot.calibrate import Calibration

CALIBRATION = Calibration(
    robot="pybullet",
    arm="panda",
    step_s=0.04,
    set_points_per_step=10,
    max_speed_m_s=1.7,
    max_acceleration_m_s2=11.0,
    covered_share=(0.6, 0.6, 0.5),
    training_share=(0.6, 0.6, 0.6),
    delay_steps=0.4,
)


def test_a_tip_is_inside_the_limits_by_speed_and_acceleration():
    gap_s = 0.01
    times = np.arange(6) * gap_s
    steady = np.outer(1.69 * times, [1.0, 0.0, 0.0])
    assert inside_limits(steady, gap_s).all()
    assert not inside_limits(steady * 1.02, gap_s).any()
    assert inside_limits(np.outer(12.9 * times**2 / 2, [0.0, 0.0, 1.0]), gap_s).all()
    assert not inside_limits(np.outer(13.5 * times**2 / 2, [0.0, 0.0, 1.0]), gap_s).any()


def test_rates_count_goals_stops_and_steps():
    played = [
        Played(reached=True, ever=True, stopped="", inside=(40, 50), num_steps=50, free=(30, 27)),
        Played(reached=False, ever=True, stopped="stopped: late", inside=(10, 10), num_steps=10, free=(10, 9)),
        Played(reached=False, ever=False, stopped="", inside=(25, 50), num_steps=50),
        Played(reached=True, ever=True, stopped="", inside=(50, 50), num_steps=50),
    ]
    found = summarise(played)
    assert (found["num_goals"], found["success_last"], found["success_ever"]) == (4, 0.5, 0.75)
    assert found["success_last_low"] < 0.5 < found["success_last_high"]
    assert found["tip_inside"] == pytest.approx(125 / 160)
    assert found["set_point_inside"] == 1.0
    assert (found["free"], found["free_tip_inside"]) == (40 / 160, 36 / 40)
    assert (found["num_stops"], found["stops"]) == (1, ["stopped: late"])


def test_goals_are_drawn_for_the_cube_of_the_engine():
    settings = Settings(num_goals=40)
    starts, goals = draw_episodes(policy_of_row(ROWS["nominal"], settings), settings)
    assert starts.shape == goals.shape == (40, 3)
    np.testing.assert_allclose(starts[:, 2], 0.02)
    assert (goals[:, 2] == 0.02).sum() in range(5, 20)  # 30 % of them on the table


def test_a_chunk_is_played_alike_again_in_the_real_engine():
    pytest.importorskip("pybullet", reason="needs PyBullet: pip install 'tandem-skills[pybullet]'")
    asked = ROWS["together"], 0, Settings(num_goals=2, num_steps=8), CALIBRATION.gain
    first = play_chunk(*asked)
    assert [each.stopped for each in first] == ["", ""]
    assert [each.num_steps for each in first] == [8, 8]
    assert play_chunk(*asked) == first
    assert all(0 < each.free[0] <= 8 for each in first)  # it comes from above


def test_each_seed_of_goals_has_its_share_in_the_table(monkeypatch):
    pytest.importorskip("pybullet", reason="needs PyBullet: pip install 'tandem-skills[pybullet]'")
    monkeypatch.setattr(transfer, "ROWS", {"nominal": ROWS["nominal"]})
    found = transfer.benchmark(Settings(num_goals=3, num_steps=2, num_seeds=2))["rows"]["nominal"]
    assert (found["num_goals"], len(found["success_last_each"])) == (6, 2)
    shares = {"success_last": 0.5, "success_last_low": 0.2, "success_last_high": 0.8, "success_ever": 0.5}
    shown = transfer.transfer_table({"rows": {"nominal": found | shares | {"success_last_each": [1 / 3, 2 / 3]}}})
    assert "| 50.0 % (20 % to 80 %): 33.3 %, 66.7 % | 50.0 % |" in shown
