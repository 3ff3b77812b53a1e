import pytest

from service.config import parse_config
from service.media import artifacts
from service.media.artifacts import make_artifacts
from service.registry.loading import load
from service.store.run_directory import RunDirectory
from tests.runs.runs import TREE, assert_one_line, no_room_above, play


@pytest.fixture(scope="module")
def directory(tmp_path_factory):
    path = tmp_path_factory.mktemp("run")
    play(path)
    return RunDirectory(path)


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    monkeypatch.setattr(artifacts, "NUM_SKILLS", 2)
    monkeypatch.setattr(artifacts, "COVERAGE_STEPS", 2)
    monkeypatch.setattr("service.media.recording.record_rounds", lambda *args, **kwargs: [])
    monkeypatch.setattr("service.media.video.write_video", lambda takes, world, path, options: path)


def test_every_picture_by_what_it_shows(directory):
    files = make_artifacts(directory)
    assert list(files) == ["curves", "goals", "coverage", "video"]
    assert all(files[name].stat().st_size > 10_000 for name in ("curves", "goals", "coverage"))


def test_a_run_in_which_alice_does_not_play_has_a_film_of_episodes(tmp_path, monkeypatch):
    game = TREE["game"] | {"alice_plays": False}
    generator = TREE.get("generator", {}) | {"goal_source": "uniform", "past_opponent_fraction": 0.0}
    play(tmp_path, parse_config(TREE | {"game": game, "generator": generator}, where="a test"))
    made = []
    monkeypatch.setattr(
        "service.media.video.write_episode_video", lambda recorded, world, path, options: made.append(path)
    )
    artifacts._draw_video(RunDirectory(tmp_path), load(tmp_path))
    assert [path.name for path in made] == ["episodes.mp4"]


def test_pictures_for_which_there_is_no_room_are_left_out(directory, caplog):
    for name in ("curves", "goals", "coverage"):
        (directory.path / f"{name}.png").write_bytes(b"older")
    before = {path: path.read_bytes() for path in directory.path.glob("*.png")}
    with no_room_above(5_000):
        assert list(make_artifacts(directory)) == ["video"]
    for message, name in zip(caplog.messages, ("curves", "goals", "coverage"), strict=True):
        assert_one_line(message, f"no {name}", f"{name}.png", "File too large")
    assert {path: path.read_bytes() for path in directory.path.glob("*.png")} == before
    assert list(directory.path.glob(".tmp-*")) == []


def test_an_error_of_a_library_leaves_out_its_picture_alone(directory, monkeypatch, caplog):
    monkeypatch.setattr(artifacts, "plot_curves", lambda *_: 1 / 0)
    assert list(make_artifacts(directory)) == ["goals", "coverage", "video"]
    assert caplog.messages == ["no curves: ZeroDivisionError: division by zero"]
