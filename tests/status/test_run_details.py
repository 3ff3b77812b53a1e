"""Configuration, commands and goals of a run, from its directory."""

import shlex

import pytest

from service.status import run_details
from tests.status.runs import append, grid, status, write_status


def test_goals_over_a_run(tmp_path):
    write_status(tmp_path, "cube")
    low, high = [0, 0, 0.025, 0.01, 0.01, 0.03], [0, 0, 0.025, 0.01, 0.01, 0.13]
    for i in range(1, 41):
        goals = [[*low, 1], [*low, 0], [*high, 1.0 if i > 20 else 0.0], [None, *low]]
        append(tmp_path, "cube", {"iteration": i, "env_steps": 100 * i, "goals": goals}, file="goals.jsonl")
        append(tmp_path, "cube", {"iteration": i, "goals": "text"}, file="goals.jsonl")  # passed over
    found = run_details.goal_frames(tmp_path / "cube", grid(), 2)
    first, second = found.frames
    assert found.cell_size_m == 0.05
    assert first.centers_m == second.centers_m == ((0.025, 0.025, 0.025), (0.025, 0.025, 0.125))
    assert (first.first_env_steps, second.last_env_steps) == (100, 4000)
    assert first.num_goals + second.num_goals == 120
    assert first.num_tries[0] == 2 * first.num_tries[1]
    assert first.success_rate[0] == 0.5
    assert first.success_rate[1] < 0.1  # parts are of equal bytes, so one of his goals may be in the first
    assert second.success_rate == (0.5, 1.0)
    assert run_details.goal_frames(tmp_path / "gone", None, 2).frames == ()


@pytest.fixture
def directory(tmp_path):
    directory = tmp_path / "a night" / "seed-3"
    directory.mkdir(parents=True)
    (directory / "config.yaml").write_text("seed: 3\n")
    return directory


def test_commands(directory, tmp_path):
    ended = status("night", state="finished", options=("--runtime", "ray", "--no-publish"))
    found = run_details.setup(ended, directory, tmp_path / "registry")
    assert found.config == {"seed": 3}
    assert shlex.split(found.stop_command) == ["touch", str(directory / "stop")]
    place = ["--registry", str(tmp_path / "registry")]
    begun = ["tandem", "train", "--resume", "--run-dir", str(directory)]
    assert shlex.split(found.resume_command) == [*begun, *place, "--runtime", "ray", "--no-publish"]
    assert [shlex.split(each.command) for each in found.commands] == [
        ["tandem", *words, *place]
        for words in (
            ["evaluate", str(directory)],
            ["play", str(directory)],
            ["render", str(directory), "--out", "panda-cube.mp4"],
            ["publish", str(directory), "--name", "panda-cube"],
        )
    ]
    assert run_details.setup(status("night"), directory, tmp_path).commands == ()


def test_commands_of_a_run_of_a_study_go_on_with_the_study(directory, tmp_path):
    (directory.parent / "study.json").write_text("x: 1\n")
    run, registry = status("night-seed-3", options=("--no-publish",)), str(tmp_path / "registry")
    place = ["tandem", "train", "--resume", "--run-dir", str(directory.parent), "--registry", registry]
    for text, options in (
        ("x: 1\n", []),
        ("[]", []),
        ('{"options": ["--runtime", "ray", "--address", "host:1"]}', ["--runtime", "ray", "--address", "host:1"]),
    ):
        (directory.parent / "study.json").write_text(text)
        found = run_details.setup(run, directory, tmp_path / "registry")
        assert shlex.split(found.resume_command) == [*place, *options]


def test_a_configuration_that_cannot_be_read(tmp_path):
    found = run_details.setup(status("cube", state="failed"), tmp_path, tmp_path)
    assert (found.config, found.commands) == (None, ())
    assert found.problem.startswith(f"{tmp_path}/config.yaml is not there")
    (tmp_path / "config.yaml").write_text("[" * 5000)
    assert "nested" in run_details.setup(status("cube"), tmp_path, tmp_path).problem
    assert run_details.setup(status("cube"), None, tmp_path).directory is None
    assert run_details.log(None, 5).num_entries == 0


@pytest.mark.parametrize(
    ("text", "refused"),
    [
        ("skills: {zero_shot: none}\n", {"evaluate", "play"}),
        ("skills: {zero_shot: way}\n", set()),
        ("skills: 3\n", set()),  # written by hand
        ("task: wall\nprimitives_digest:\n", {"publish"}),
        ("task: wall\nprimitives_digest: abc\n", set()),
        ("method: self-play\n", set()),
        ("method: mine.py:Climb\n", {"evaluate", "play", "render", "publish"}),  # makes nothing of a known kind
    ],
)
def test_what_a_method_refuses_is_no_command(directory, tmp_path, text, refused):
    (directory / "config.yaml").write_text(text)
    found = run_details.setup(status("night", state="finished"), directory, tmp_path)
    offered = {shlex.split(each.command)[1] for each in found.commands}
    assert offered == {"evaluate", "play", "render", "publish"} - refused
