"""Videos of recorded rounds and episodes: their frames, captions and files."""

import dataclasses

import imageio_ffmpeg
import numpy as np
import pytest

from service.config import WorldConfig
from service.envs.batch import WorldBatch
from service.envs.rendering.renderer import RenderError, SceneRenderer
from service.errors import TandemError
from service.generator.validity import Verdict
from service.media import video
from service.media.recording import RecordedEpisodes, RecordedRound
from service.media.video import BAR_HEIGHT, write_episode_video, write_video

PANE = 48


@pytest.fixture(scope="module", autouse=True)
def _needs_opengl():
    try:
        SceneRenderer(WorldConfig(), 16, 16).close()
    except RenderError as error:
        pytest.skip(str(error))


@pytest.fixture(autouse=True)
def _small_panes(monkeypatch):
    monkeypatch.setattr(video, "PANE_SIZE", PANE)
    monkeypatch.setattr(video, "EPISODE_PANE_SIZE", PANE)


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
    path = write_video([recorded(), recorded(solved=False)], WorldConfig(), tmp_path / "new" / "rounds.mp4")
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
    path = write_video([played], WorldConfig(), tmp_path / "rounds.mp4")
    assert len(read_video(path)[0]) == 4 + 20


def test_on_a_slow_machine_every_second_state_is_drawn(tmp_path, monkeypatch):
    monkeypatch.setattr(video, "MAX_DRAWING_S", 0.0)
    path = write_video([recorded()], WorldConfig(), tmp_path / "rounds.mp4")
    # 12.5 fps: states 0, 2, 3 of Alice, 0.4 s, 0 and 2 of Bob, 0.8 s.
    frames, fps = read_video(path)
    assert len(frames) == 3 + 5 + 2 + 10
    assert fps == 12.5


def test_the_caption_tells_what_happened():
    assert video._result(recorded(num_bob_steps=30), 0.04)[0] == "Bob: solved after 1.2 s"
    assert video._result(recorded(num_bob_steps=40, solved=False), 0.04)[0] == "Bob: not solved in 1.6 s"
    assert set(video._NO_GOAL) == set(Verdict) - {Verdict.VALID}
    assert (video._bar(200, "Bob", (0, 0, 0), "") != video._bar(200, "Alice", (0, 0, 0), "")).any()


def test_episodes_stand_in_rows_of_three(tmp_path):
    states = np.tile(still(1)[:, None], (1, 4, 1))
    goal = np.tile([0.0, 0.1, 0.2], (4, 1))
    episodes = RecordedEpisodes(states, goal, np.zeros((2, 4), dtype=bool))
    frames, _ = read_video(write_episode_video(episodes, WorldConfig(), tmp_path / "bob.mp4"))
    assert frames.shape == (2 + 20, 2 * (PANE + BAR_HEIGHT), 3 * PANE, 3)
    assert frames[0, -PANE:, PANE + 8 :].min() > 230  # two of six places are empty


def test_skills_have_no_goal_and_never_arrive(tmp_path):
    states = np.tile(still(1)[:, None], (1, 3, 1))
    skills = RecordedEpisodes(states, None, np.zeros((2, 3), dtype=bool))
    drawn, _ = read_video(write_episode_video(skills, WorldConfig(), tmp_path / "skills.mp4"))
    with_goals = dataclasses.replace(skills, goal=np.tile([0.0, 0.1, 0.2], (3, 1)))
    other, _ = read_video(write_episode_video(with_goals, WorldConfig(), tmp_path / "goals.mp4"))
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
        video._encode(frames(), path, fps=25)
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


def test_a_place_that_cannot_be_written(tmp_path):
    (tmp_path / "file").write_bytes(b"")
    frame = np.zeros((32, 32, 3), dtype=np.uint8)
    with pytest.raises(TandemError, match=r"cannot write .*rounds\.mp4"):
        video._encode(iter([frame]), tmp_path / "file" / "rounds.mp4", fps=25)
    with pytest.raises(TandemError, match="ffmpeg says"):  # odd sizes are no H.264
        video._encode(iter([np.zeros((31, 31, 3), dtype=np.uint8)]), tmp_path / "odd.mp4", fps=25)
    assert [path.name for path in tmp_path.iterdir()] == ["file"]
