"""Videos of recorded rounds, Alice's turn beside Bob's, and of recorded episodes, several at once.

A video is H.264 and plays in real time. Without a graphics card a picture takes 50 to 100 ms to draw, so a slow
machine's video shows only every second state.
"""

from __future__ import annotations

import contextlib
import errno
import functools
import itertools
import os
import subprocess
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from service.config import WorldConfig
from service.envs.rendering.renderer import Image, RenderError, SceneRenderer
from service.generator.validity import Verdict
from service.io.files import TEMPORARY_PREFIX, os_errors
from service.liveness import count_work
from service.media.recording import RecordedEpisodes, RecordedRound
from service.progress import counted
from service.types import StateArray

Colour = tuple[int, int, int]

PANE_SIZE, EPISODE_PANE_SIZE = 400, 272
"""Width and height of one player's, and of one episode's picture, pixels, even."""
BAR_HEIGHT = 36
"""Height of the caption over each picture, pixels."""
EPISODE_COLUMNS = 3
MAX_DRAWING_S = 25.0
"""Only every second state is drawn if all of them would take longer."""
GOAL_PAUSE_S, END_PAUSE_S = 0.4, 0.8

_PAPER, _INK, _FAINT = (248, 248, 248), (34, 34, 34), (140, 140, 140)
_BLUE, _ORANGE, _GREEN = (0, 114, 178), (213, 94, 0), (0, 138, 100)
_NO_GOAL = {
    Verdict.NOT_MOVED: "the object hardly moved",
    Verdict.OUTSIDE: "it left the workspace",
    Verdict.FALLEN: "it fell off the table",
}


def write_video(rounds: Sequence[RecordedRound], config: WorldConfig, path: Path) -> Path:
    """Write rounds one after another, Alice on the left and Bob on the right.

    Args:
        rounds: at least one, from ``record_rounds``.
        config: the world they were played in.
        path: where to; an mp4 that takes its name only when it is whole.

    Returns:
        ``path``.

    Raises:
        RenderError: no OpenGL or no ffmpeg here.
        TandemError: the disk is full or the file cannot be written.
    """
    num_pictures = sum(len(each.alice_states) + len(each.bob_states) for each in rounds)
    step_s = _step_s(config)
    with SceneRenderer(config, PANE_SIZE, PANE_SIZE) as renderer:
        stride = _stride(renderer, rounds[0].alice_states[0], num_pictures)
        frames = (
            frame
            for number, each in enumerate(rounds, start=1)
            for frame in _round_frames(renderer, each, f"{number}/{len(rounds)}", stride, step_s)
        )
        num = sum(_num_frames(each, stride, stride * step_s) for each in rounds)
        return _encode(counted(frames, "drawing the video", num, "pictures"), path, fps=1 / (stride * step_s))


def write_episode_video(episodes: RecordedEpisodes, config: WorldConfig, path: Path) -> Path:
    """Write episodes all at once, in rows of three; arguments and errors are those of ``write_video``."""
    num_steps, num_episodes = episodes.reached.shape
    with SceneRenderer(config, EPISODE_PANE_SIZE, EPISODE_PANE_SIZE) as renderer:
        stride = _stride(renderer, episodes.states[0, 0], num_steps * num_episodes)
        frame_s = stride * _step_s(config)
        frames = _episode_frames(renderer, episodes, stride, frame_s)
        num = len(_thinned(num_steps, stride)) + _num_held(END_PAUSE_S, frame_s)
        return _encode(counted(frames, "drawing the video", num, "pictures"), path, fps=1 / frame_s)


# --- what is shown -------------------------------------------------------------------------------------------------


def _round_frames(
    renderer: SceneRenderer, played: RecordedRound, number: str, stride: int, step_s: float
) -> Iterator[Image]:
    """Alice moves while Bob waits, then Bob moves, then both rest; ``number`` stands in the caption."""
    frame_s = stride * step_s
    faded = (0.45 * renderer.render(played.bob_states[0]) + 0.55 * 235).astype(np.uint8)
    right = _caption(faded, "Bob waits", _FAINT, number)
    for step in _thinned(len(played.alice_states), stride):
        picture = renderer.render(played.alice_states[step])
        yield np.hstack([_caption(picture, "Alice proposes a goal", _ORANGE), right])
    if played.verdict != Verdict.VALID:
        left = _caption(picture, f"Alice: no goal, {_NO_GOAL[played.verdict]}", _ORANGE)
        yield from _hold(np.hstack([left, right]), END_PAUSE_S, frame_s)
        return
    left = _caption(picture, "Alice proposed this goal", _INK)
    picture = renderer.render(played.bob_states[0], played.goal)
    yield from _hold(np.hstack([left, _caption(picture, "Bob's turn", _BLUE, number)]), GOAL_PAUSE_S, frame_s)
    for step in _thinned(len(played.bob_states), stride):
        picture = renderer.render(played.bob_states[step], played.goal)
        yield np.hstack([left, _caption(picture, f"Bob tries: {step * step_s:.1f} s", _BLUE, number)])
    yield from _hold(np.hstack([left, _caption(picture, *_result(played, step_s), number)]), END_PAUSE_S, frame_s)


def _result(played: RecordedRound, step_s: float) -> tuple[str, Colour]:
    elapsed_s = (len(played.bob_states) - 1) * step_s
    if played.solved:
        return f"Bob: solved after {elapsed_s:.1f} s", _GREEN
    return f"Bob: not solved in {elapsed_s:.1f} s", _ORANGE


def _episode_frames(
    renderer: SceneRenderer, episodes: RecordedEpisodes, stride: int, frame_s: float
) -> Iterator[Image]:
    num = episodes.states.shape[1]
    for step in _thinned(len(episodes.states), stride):
        panes = []
        for episode in range(num):
            goal = None if episodes.goal is None else episodes.goal[episode]
            picture = renderer.render(episodes.states[step, episode], goal)
            text, colour = ("at the goal", _GREEN) if episodes.reached[step, episode] else ("on the way", _FAINT)
            if goal is None:
                text = "random skill"
            panes.append(_caption(picture, text, colour, f"{episode + 1}/{num}"))
        frame = _grid(panes)
        yield frame
    yield from _hold(frame, END_PAUSE_S, frame_s)


def _step_s(config: WorldConfig) -> float:
    return config.physics_step_s * config.num_substeps


def _stride(renderer: SceneRenderer, state: StateArray, num_pictures: int) -> int:
    """1, or 2 where this machine is too slow to draw every state."""
    renderer.render(state)  # the first picture takes longer
    start = time.perf_counter()
    renderer.render(state)
    return 1 if num_pictures * (time.perf_counter() - start) <= MAX_DRAWING_S else 2


def _thinned(num: int, stride: int) -> list[int]:
    """Every ``stride``-th of ``num`` indices, and always the last."""
    return [*range(0, num - 1, stride), num - 1]


def _hold(frame: Image, pause_s: float, frame_s: float) -> list[Image]:
    return [frame] * _num_held(pause_s, frame_s)


def _num_held(pause_s: float, frame_s: float) -> int:
    return max(round(pause_s / frame_s), 1)


def _num_frames(played: RecordedRound, stride: int, frame_s: float) -> int:
    """Number of frames that ``_round_frames`` gives."""
    num = len(_thinned(len(played.alice_states), stride)) + _num_held(END_PAUSE_S, frame_s)
    if played.verdict != Verdict.VALID:
        return num
    return num + len(_thinned(len(played.bob_states), stride)) + _num_held(GOAL_PAUSE_S, frame_s)


# --- pictures ------------------------------------------------------------------------------------------------------


def _grid(panes: list[Image]) -> Image:
    """Panes in rows of three, the last row filled up with paper."""
    columns = min(len(panes), EPISODE_COLUMNS)
    panes = panes + [np.full_like(panes[0], _PAPER)] * (-len(panes) % columns)
    return np.vstack([np.hstack(panes[first : first + columns]) for first in range(0, len(panes), columns)])


def _caption(image: Image, text: str, colour: Colour, number: str = "") -> Image:
    return np.vstack([_bar(image.shape[1], text, colour, number), image])


@functools.lru_cache(maxsize=64)
def _bar(width: int, text: str, colour: Colour, number: str) -> Image:
    from PIL import Image as Pillow
    from PIL import ImageDraw, ImageFont

    bar = Pillow.new("RGB", (width, BAR_HEIGHT), _PAPER)
    drawing, font = ImageDraw.Draw(bar), ImageFont.load_default(17)
    drawing.text((12, BAR_HEIGHT / 2), text, fill=colour, font=font, anchor="lm")
    drawing.text((width - 12, BAR_HEIGHT / 2), number, fill=_FAINT, font=font, anchor="rm")
    return np.asarray(bar)


# --- file ----------------------------------------------------------------------------------------------------------


def _encode(frames: Iterator[Image], path: Path, *, fps: float) -> Path:
    """Write frames as H.264; the file takes its name only when it is whole."""
    temporary = path.parent / f"{TEMPORARY_PREFIX}{os.getpid()}-{path.name}"
    with os_errors("write", path):
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            _run_ffmpeg(frames, temporary, fps)
            temporary.replace(path)
        finally:
            temporary.unlink(missing_ok=True)
    return path


def _run_ffmpeg(frames: Iterator[Image], path: Path, fps: float) -> None:
    """Send frames to ffmpeg.

    ``imageio_ffmpeg.write_frames`` would be shorter, but ignores ffmpeg's exit status: a full disk would go unnoticed.
    """
    first = next(frames)
    height, width = first.shape[:2]
    command = [
        _ffmpeg(), "-y", "-loglevel", "error", "-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}",
        "-r", f"{fps:g}", "-i", "pipe:", "-c:v", "libx264", "-pix_fmt", "yuv420p", "-crf", "21", "-preset", "veryfast",
        "-movflags", "+faststart", "-f", "mp4", str(path),
    ]  # fmt: skip
    with subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE) as ffmpeg:
        assert ffmpeg.stdin is not None
        try:
            with contextlib.suppress(BrokenPipeError):  # it stopped early; its exit status says why
                for frame in itertools.chain([first], frames):
                    count_work()
                    ffmpeg.stdin.write(frame.tobytes())
            words = ffmpeg.communicate()[1].decode(errors="replace").strip()
        except BaseException:
            ffmpeg.kill()
            raise
    if ffmpeg.returncode:
        raise OSError(errno.EIO, f"ffmpeg says {words.splitlines()[-1] if words else ffmpeg.returncode!r}")


def _ffmpeg() -> str:
    import imageio_ffmpeg

    try:
        return str(imageio_ffmpeg.get_ffmpeg_exe())
    except RuntimeError:
        raise RenderError("cannot write a video: there is no ffmpeg; install it (apt-get install ffmpeg)") from None
