"""The benchmark of what each range of randomisation costs: its worlds, a short student, its page."""

from benchmarks.randomisation_ranges import Settings, measure_range, worlds_of
from benchmarks.report.robustness import ranges_table
from service.randomisation_config import RandomisationConfig


def test_each_range_is_drawn_alone_and_all_of_them_together():
    drawn = RandomisationConfig(num_models=4, friction=(0.5, 1.0), delay_steps=(0, 2))
    worlds = worlds_of(drawn)
    assert list(worlds) == ["nothing", "friction", "delay_steps", "everything"]
    assert worlds["nothing"] == RandomisationConfig()
    assert worlds["friction"] == RandomisationConfig(num_models=4, friction=(0.5, 1.0))
    assert worlds["everything"] == drawn


def test_a_student_is_measured_beside_his_teacher_in_both_worlds():
    row = measure_range("object_noise_m", Settings(env_steps=1, episodes=4))
    assert row["ranges"] == {"num_models": 32, "object_noise_m": [0.0, 0.012]}
    rates = [row[f"{player}_{world}"] for player in ("student", "teacher") for world in ("nominal", "drawn")]
    assert [each["num_episodes"] for each in rates] == [4, 4, 4, 4]
    assert (
        row["student_nominal"]["success_last"] < 0.4 < row["teacher_nominal"]["success_last"]
    )  # he learned nothing yet


def test_the_table_has_the_range():
    rate = {"success_last": 0.5}
    names = "student_nominal", "student_drawn", "teacher_drawn"
    row = dict.fromkeys(names, rate) | {"ranges": {"num_models": 4, "friction": [0.25, 1.2]}}
    text = ranges_table({"rows": {"friction": row, "everything": row | {"ranges": {}}}})
    assert "| friction | 0.25 to 1.2 | 50.0 % | 50.0 % | 50.0 % |" in text
    assert text.endswith("| everything |  | 50.0 % | 50.0 % | 50.0 % |")
