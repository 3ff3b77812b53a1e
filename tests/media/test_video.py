"""Videos of recorded rounds and episodes: their frames, captions and files."""

import dataclasses
from pathlib import Path

import imageio_ffmpeg
import numpy as np
import pytest

from service.base.errors import TandemError
from service.config import WorldConfig
from service.envs.batch import WorldBatch
from service.envs.rendering.camera import parse_view
from service.envs.rendering.renderer import SceneRenderer
from service.generator.validity import NO_GOAL, Verdict
from service.media import encoding, video
from service.media.recording import RecordedEpisodes, RecordedRound
from service.media.video import BAR_HEIGHT, FilmOptions, pane_rows, write_episode_video, write_video

PANE = 48
SMALL = FilmOptions(width=2 * PANE, height=PANE + BAR_HEIGHT)


@pytest.fixture(scope="module", autouse=True)
def _needs_opengl():
    try:
        SceneRenderer(WorldConfig(), 16, 16).close()
    except TandemError as error:
        if not str(error).startswith("cannot draw"):
            raise
        pytest.skip(str(error))


def still(num_steps):
    """(T + 1, S) states in which nothing moves."""
    with WorldBatch(WorldConfig(), 1, num_threads=1) as worlds:
        return np.tile(worlds.states[0], (num_steps + 1, 1))


def recorded(num_alice_steps=3, num_bob_steps=2, **changes):
    fields = {
        "alice_states": still(num_alice_steps), "alice_actions": np.zeros((num_alice_steps, 4)),
        "bob_states": still(num_bob_steps), "bob_actions": np.zeros((num_bob_steps, 4)),
        "goal": np.array([0.0, 0.1, 0.2]), "solved": True,
    }  # fmt: skip
    return RecordedRound(**fields | changes)


def read_video(path):
    """(T, H, W, 3) frames, and frames per second."""
    frames = imageio_ffmpeg.read_frames(path)
    meta = next(frames)
    width, height = meta["size"]
    return np.stack([np.frombuffer(frame, np.uint8).reshape(height, width, 3) for frame in frames]), meta["fps"]


def test_a_video_has_every_state_and_its_pauses(tmp_path):
    path = write_video([recorded(), recorded(solved=False)], WorldConfig(), tmp_path / "new" / "rounds.mp4", SMALL)
    frames, fps = read_video(path)
    # 25 fps: 4 of Alice, 0.4 s, 3 of Bob, 0.8 s; twice.
    assert frames.shape == (2 * (4 + 10 + 3 + 20), PANE + BAR_HEIGHT, 2 * PANE, 3)
    assert fps == 25.0
    assert [file.name for file in path.parent.iterdir()] == ["rounds.mp4"]
    # While Alice moves, Bob's picture is faded; then it is as hers.
    left, right = frames[2, BAR_HEIGHT:, :PANE].astype(int), frames[2, BAR_HEIGHT:, PANE:].astype(int)
    assert right.min() > 100 > left.min()
    assert abs(frames[20, BAR_HEIGHT:, :PANE].mean() - frames[20, BAR_HEIGHT:, PANE:].mean()) < 5


def test_without_a_goal_bob_has_no_turn(tmp_path):
    played = recorded(num_bob_steps=0, solved=False, verdict=Verdict.OUTSIDE)
    path = write_video([played], WorldConfig(), tmp_path / "rounds.mp4", SMALL)
    assert len(read_video(path)[0]) == 4 + 20


def test_captions_tell_what_happened(tmp_path, monkeypatch):
    def captions(write, *shown):
        told = []

        def caption(picture, text, colour, number=""):
            told.append(text)
            return drawn(picture, text, colour, number)

        monkeypatch.setattr(video, "_caption", caption)
        write(*shown, WorldConfig(), tmp_path / "film.mp4", SMALL)
        return list(dict.fromkeys(told))

    drawn = video._caption
    begins = ["Bob waits", "Alice proposes a goal"]
    turn = ["Alice proposed this goal", "Bob's turn", "Bob tries: 0.0 s", "Bob tries: 0.1 s"]
    assert captions(write_video, [recorded()]) == [*begins, *turn, "Bob: solved after 0.1 s"]
    assert captions(write_video, [recorded(solved=False)]) == [*begins, *turn, "Bob: not solved in 0.1 s"]
    assert set(NO_GOAL) == set(Verdict) - {Verdict.VALID}
    for verdict, reason in NO_GOAL.items():
        played = recorded(num_bob_steps=0, solved=False, verdict=verdict)
        assert captions(write_video, [played]) == [*begins, f"Alice: no goal, {reason}"]
    reached = np.array([[False], [False], [True]])
    episode = RecordedEpisodes(still(2)[:, None], np.array([[0.0, 0.1, 0.2]]), reached)
    assert captions(write_episode_video, episode) == ["on the way", "at the goal"]
    assert (video._bar(200, "Bob", (0, 0, 0), "") != video._bar(200, "Alice", (0, 0, 0), "")).any()


def num_red(image):
    """Pixels as red as the object."""
    image = image.astype(int)
    return ((image[..., 0] > 80) & (image[..., 0] > 2 * image[..., 1]) & (image[..., 0] > 2 * image[..., 2])).sum()


def test_episodes_fill_the_film_and_a_gif_is_read_back(tmp_path):
    """Two and one: three times the object, and no tile without a picture. A fast film leaves states out."""
    states = np.tile(still(8)[:, None], (1, 3, 1))
    episodes = RecordedEpisodes(states, np.tile([0.0, 0.1, 0.2], (3, 1)), np.zeros((9, 3), dtype=bool))
    options = FilmOptions(320, 240 + 2 * BAR_HEIGHT, parse_view("close"), speed=4.0)
    frames, fps = read_video(write_episode_video(episodes, WorldConfig(), tmp_path / "bob.gif", options))
    assert frames.shape[1:] == (240 + 2 * BAR_HEIGHT, 320, 3)
    assert fps == 50.0  # 100 states a second: every second one
    panes = [frames[0, BAR_HEIGHT:156, :160], frames[0, BAR_HEIGHT:156, 160:], frames[0, -120:]]
    assert all(num_red(pane) > 40 for pane in panes), [num_red(pane) for pane in panes]
    assert all(pane.std() > 20 for pane in panes)
    uneven = dataclasses.replace(options, width=322, height=180)  # three in a row: 107, 107 and 108 pixels
    assert read_video(write_episode_video(episodes, WorldConfig(), tmp_path / "b.gif", uneven))[0].shape[2] == 322


@pytest.mark.parametrize("num", range(1, 20))
def test_panes_fill_the_film(num):
    rows = pane_rows(num, 1280, 720)
    assert sum(map(len, rows)) == num
    assert {sum(width for width, _ in row) for row in rows} == {1280}
    assert 720 - len(rows) < sum(row[0][1] + BAR_HEIGHT for row in rows) <= 720
    assert all(0.5 < width / height < 3.0 for row in rows for width, height in row)


def test_skills_have_no_goal_and_never_arrive(tmp_path):
    states = np.tile(still(1)[:, None], (1, 3, 1))
    skills = RecordedEpisodes(states, None, np.zeros((2, 3), dtype=bool))
    drawn, _ = read_video(write_episode_video(skills, WorldConfig(), tmp_path / "skills.mp4", SMALL))
    with_goals = dataclasses.replace(skills, goal=np.tile([0.0, 0.1, 0.2], (3, 1)))
    other, _ = read_video(write_episode_video(with_goals, WorldConfig(), tmp_path / "goals.mp4", SMALL))
    assert drawn.shape == other.shape
    difference = np.abs(drawn[0].astype(int) - other[0])
    assert difference[:BAR_HEIGHT].max() > 50  # another caption
    assert difference[BAR_HEIGHT:].max() > 50  # and no object at a goal


def test_a_video_that_fails_leaves_the_old_one(tmp_path):
    path = tmp_path / "rounds.mp4"
    path.write_bytes(b"old")

    def frames():
        yield np.zeros((32, 32, 3), dtype=np.uint8)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        encoding.encode(frames(), path, fps=25)
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


def test_a_place_that_cannot_be_written(tmp_path):
    (tmp_path / "file").write_bytes(b"")
    frame = np.zeros((32, 32, 3), dtype=np.uint8)
    with pytest.raises(TandemError, match=r"cannot write .*rounds\.mp4"):
        encoding.encode(iter([frame]), tmp_path / "file" / "rounds.mp4", fps=25)
    with pytest.raises(TandemError, match=r"rounds\.avi: a film ends in \.mp4 or \.gif"):
        encoding.encode(iter([frame]), tmp_path / "rounds.avi", fps=25)
    with pytest.raises(TandemError, match="ffmpeg says"):  # odd sizes are no H.264
        encoding.encode(iter([np.zeros((31, 31, 3), dtype=np.uint8)]), tmp_path / "odd.mp4", fps=25)
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_pictures_that_do_not_fit_are_told():
    with pytest.raises(TandemError, match="64 pictures do not fit into 64x64: render fewer, or give a larger --size"):
        pane_rows(64, 64, 64)
    assert min(min(pane) for row in pane_rows(64, 1280, 720) for pane in row) > 0


def test_a_film_may_have_a_colon_in_its_path(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a:b").mkdir()
    states = np.tile(still(1)[:, None], (1, 1, 1))
    episodes = RecordedEpisodes(states, None, np.zeros((len(states), 1), dtype=bool))
    path = write_episode_video(episodes, WorldConfig(), Path("a:b/film.mp4"), SMALL)
    assert path.stat().st_size > 0
