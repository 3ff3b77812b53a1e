import imageio.v3 as iio
import numpy as np
import pytest

from service.config import Config, GameConfig, WorldConfig
from service.envs.batch import WorldBatch
from service.envs.rendering.renderer import RenderError, SceneRenderer
from service.errors import TandemError
from service.generator.validity import Verdict
from service.media import recording as film
from service.media import video
from service.media.recording import Episodes, Take, film_episodes, film_rounds
from service.media.video import BAR_HEIGHT, write_episode_video, write_video

PANE = 48
CONFIG = Config(game=GameConfig(alice_steps=12, bob_steps=12))
PUSH = np.array([-1.0, 0.0, -1.0, -1.0], dtype=np.float32)


@pytest.fixture(scope="module", autouse=True)
def _needs_opengl():
    try:
        SceneRenderer(WorldConfig(), 16, 16).close()
    except RenderError as error:
        pytest.skip(str(error))


class Constant:
    """Alice or Bob: the same action always."""

    def __init__(self, action):
        self.action = np.asarray(action, dtype=np.float32)

    def act(self, observation, rng):
        return self.act_deterministic(observation), np.zeros(len(observation), dtype=np.float32)

    def act_deterministic(self, observation):
        return np.tile(self.action, (len(observation), 1))


def still(num_steps):
    """(T + 1, S) states in which nothing moves."""
    with WorldBatch(WorldConfig(), 1, num_threads=1) as worlds:
        return np.tile(worlds.states[0], (num_steps + 1, 1))


def take(num_alice_steps=3, num_bob_steps=2, **changes):
    fields = {
        "alice_states": still(num_alice_steps), "bob_states": still(num_bob_steps), "goal": np.array([0.0, 0.1, 0.2]),
        "solved": True,
    }  # fmt: skip
    return Take(**fields | changes)


def object_in(states):
    """(..., 3) object position: after time, seven joints and two fingers."""
    return states[..., 10:13]


def test_filmed_rounds_are_rounds():
    takes = film_rounds(CONFIG, Constant(PUSH), Constant(PUSH), num_rounds=3, seed=0)
    assert len(takes) == 3
    for shot in takes:
        assert shot.verdict == Verdict.VALID
        assert shot.alice_states.shape[0] == 13
        np.testing.assert_array_equal(object_in(shot.alice_states[-1]), shot.goal)
        np.testing.assert_array_equal(shot.bob_states[0], shot.alice_states[0])
        # Bob does the same, so he comes by the same states, and stops as soon as he is near enough.
        np.testing.assert_array_equal(shot.bob_states, shot.alice_states[: len(shot.bob_states)])
        distance = np.linalg.norm(object_in(shot.bob_states) - shot.goal, axis=1)
        assert shot.solved
        assert distance[-1] <= 0.05 < distance[:-1].min()
    moved = [np.linalg.norm(shot.goal - object_in(shot.alice_states[0])) for shot in takes]
    assert moved == sorted(moved, reverse=True)


def test_a_bob_who_does_nothing_runs_out_of_time():
    (shot,) = film_rounds(CONFIG, Constant(PUSH), Constant(np.zeros(4)), num_rounds=1, seed=0)
    assert not shot.solved
    assert len(shot.bob_states) == 13


def test_an_alice_who_does_nothing_is_shown_as_she_is():
    takes = film_rounds(CONFIG, Constant([0, 0, 0, 0]), Constant(PUSH), num_rounds=2, seed=0)
    assert [shot.verdict for shot in takes] == [Verdict.NOT_MOVED] * 2
    assert [len(shot.bob_states) for shot in takes] == [1, 1]


def test_valid_before_lifted_before_far():
    start = np.tile([0.0, 0.0, 0.025], (4, 1))
    end = start + np.array([[0.30, 0, 0], [0.12, 0, 0.06], [0.20, 0, 0], [0.50, 0, 0.10]])
    verdict = np.array([Verdict.VALID, Verdict.VALID, Verdict.VALID, Verdict.OUTSIDE], dtype=np.int8)
    proposals = film._Proposals(np.zeros((4, 1, 1)), start, end, verdict)
    assert film._by_interest(proposals, 0.025).tolist() == [1, 0, 2, 3]


def test_filmed_episodes_keep_every_state():
    episodes = film_episodes(
        Constant(np.zeros(4)), WorldConfig(), "table", num_episodes=5, num_steps=4, success_distance_m=0.15, seed=2
    )
    assert episodes.states.shape[:2] == episodes.reached.shape == (5, 5)
    distance = np.linalg.norm(object_in(episodes.states) - episodes.goal, axis=2)
    np.testing.assert_array_equal(episodes.reached, distance <= 0.15)
    assert episodes.reached.any()
    assert not episodes.reached.all()


def test_a_video_has_every_state_and_its_pauses(tmp_path):
    path = write_video([take(), take(solved=False)], WorldConfig(), tmp_path / "new" / "rounds.mp4", pane_size=PANE)
    frames = iio.imread(path)
    # 25 fps: 4 of Alice, 0.4 s, 3 of Bob, 0.8 s; twice.
    assert frames.shape == (2 * (4 + 10 + 3 + 20), PANE + BAR_HEIGHT, 2 * PANE, 3)
    assert iio.immeta(path)["fps"] == 25.0
    assert [file.name for file in path.parent.iterdir()] == ["rounds.mp4"]
    # While Alice moves, Bob's picture is faded; then it is as hers.
    left, right = frames[2, BAR_HEIGHT:, :PANE].astype(int), frames[2, BAR_HEIGHT:, PANE:].astype(int)
    assert right.min() > 100 > left.min()
    assert abs(frames[20, BAR_HEIGHT:, :PANE].mean() - frames[20, BAR_HEIGHT:, PANE:].mean()) < 5


def test_without_a_goal_bob_has_no_turn(tmp_path):
    shot = take(num_bob_steps=0, solved=False, verdict=Verdict.OUTSIDE)
    path = write_video([shot], WorldConfig(), tmp_path / "rounds.mp4", pane_size=PANE)
    assert len(iio.imread(path)) == 4 + 20


def test_on_a_slow_machine_every_second_state_is_drawn(tmp_path, monkeypatch):
    monkeypatch.setattr(video, "MAX_DRAWING_S", 0.0)
    path = write_video([take()], WorldConfig(), tmp_path / "rounds.mp4", pane_size=PANE)
    # 12.5 fps: states 0, 2, 3 of Alice, 0.4 s, 0 and 2 of Bob, 0.8 s.
    assert len(iio.imread(path)) == 3 + 5 + 2 + 10
    assert iio.immeta(path)["fps"] == 12.5


def test_the_caption_tells_what_happened():
    assert video._result(take(num_bob_steps=30), 0.04)[0] == "Bob: solved after 1.2 s"
    assert video._result(take(num_bob_steps=40, solved=False), 0.04)[0] == "Bob: not solved in 1.6 s"
    assert set(video._NO_GOAL) == set(Verdict) - {Verdict.VALID}
    assert (video._bar(200, "Bob", (0, 0, 0), "") != video._bar(200, "Alice", (0, 0, 0), "")).any()


def test_episodes_stand_in_rows_of_three(tmp_path):
    states = np.tile(still(1)[:, None], (1, 4, 1))
    goal = np.tile([0.0, 0.1, 0.2], (4, 1))
    episodes = Episodes(states, goal, np.zeros((2, 4), dtype=bool))
    frames = iio.imread(write_episode_video(episodes, WorldConfig(), tmp_path / "bob.mp4", pane_size=PANE))
    assert frames.shape == (2 + 20, 2 * (PANE + BAR_HEIGHT), 3 * PANE, 3)
    assert frames[0, -PANE:, PANE + 8 :].min() > 230  # two of six places are empty


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
