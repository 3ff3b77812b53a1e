"""Videos of recorded rounds, Alice's turn beside Bob's, and of recorded episodes, several at once.

A video plays in real time unless another speed is asked for. Without a graphics card a picture takes 50 to 200 ms to
draw.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from service.base.errors import TandemError
from service.base.progress import track
from service.config import WorldConfig
from service.envs.rendering.camera import DEFAULT_VIEW, CameraView
from service.envs.rendering.renderer import Image, SceneRenderer
from service.generator.validity import NO_GOAL, Verdict
from service.media.encoding import encode
from service.media.recording import RecordedEpisodes, RecordedRound

Colour = tuple[int, int, int]

BAR_HEIGHT = 36
"""Height of the caption over each picture, pixels."""
MAX_FPS = 50.0
"""A faster film leaves states out; browsers show a GIF no faster."""
_LEAST_PANE = 8
"""Pixels of the shorter side of a picture among several."""
_PANE_SHAPE = 4 / 3
"""Width of a picture over its height that suits a scene best."""
GOAL_PAUSE_S, END_PAUSE_S = 0.4, 0.8

_PAPER, _INK, _FAINT = (248, 248, 248), (34, 34, 34), (140, 140, 140)
_BLUE, _ORANGE, _GREEN = (0, 114, 178), (213, 94, 0), (0, 138, 100)


@dataclass(frozen=True, slots=True)
class FilmOptions:
    """How a film looks."""

    width: int = 1280
    """Of the whole film, pixels, even."""
    height: int = 720
    view: CameraView = DEFAULT_VIEW
    speed: float = 1.0
    """Seconds of the world in a second of the film."""


def write_video(
    rounds: Sequence[RecordedRound], config: WorldConfig, path: Path, options: FilmOptions | None = None
) -> Path:
    """Write rounds one after another, Alice on the left and Bob on the right.

    Args:
        rounds: at least one, from ``record_rounds``.
        config: the world they were played in.
        path: where to, an mp4 or a GIF; the file takes its name only when it is whole.
        options: size, view and speed.

    Returns:
        ``path``.

    Raises:
        TandemError: no OpenGL or no ffmpeg here, no such format, the disk is full, or the file cannot be written.
    """
    options = options or FilmOptions()
    stride, frame_s = _timing(config, options.speed)
    with SceneRenderer(config, options.width // 2, options.height - BAR_HEIGHT, options.view) as renderer:
        numbered = track(enumerate(rounds, start=1), "drawing the video", len(rounds), "rounds")
        frames = (
            frame
            for number, each in numbered
            for frame in _round_frames(renderer, each, f"{number}/{len(rounds)}", stride, frame_s, config.step_s)
        )
        return encode(frames, path, fps=1 / frame_s)


def write_episode_video(
    episodes: RecordedEpisodes, config: WorldConfig, path: Path, options: FilmOptions | None = None
) -> Path:
    """Write episodes all at once, in rows that fill the film; arguments and errors are those of ``write_video``."""
    options = options or FilmOptions()
    panes = pane_rows(episodes.reached.shape[1], options.width, options.height)
    stride, frame_s = _timing(config, options.speed)
    widest = max(width for row in panes for width, _ in row)
    with SceneRenderer(config, widest, panes[0][0][1], options.view) as renderer:
        return encode(_episode_frames(renderer, episodes, panes, stride, frame_s), path, fps=1 / frame_s)


def pane_rows(num: int, width: int, height: int) -> list[list[tuple[int, int]]]:
    """Rows of panes that fill a film without a gap: (width, height) in pixels of each picture, without its caption.

    The rows have as many panes each as the number allows, or one fewer; their number is that with which pictures have
    the best shape.
    """

    def unshapely(rows: list[list[tuple[int, int]]]) -> float:
        return max(abs(math.log(pane[0] / max(pane[1], 1) / _PANE_SHAPE)) for row in rows for pane in row)

    possible = (_rows_of(num, num_rows, width, height) for num_rows in range(1, num + 1))
    fitting = [rows for rows in possible if min(min(pane) for row in rows for pane in row) >= _LEAST_PANE]
    if not fitting:
        raise TandemError(f"{num} pictures do not fit into {width}x{height}: render fewer, or give a larger --size")
    return min(fitting, key=unshapely)


def _rows_of(num: int, num_rows: int, width: int, height: int) -> list[list[tuple[int, int]]]:
    """So many panes in so many rows."""
    rows = []
    for row in range(num_rows):
        count = num // num_rows + (row < num % num_rows)
        edges = [width * column // count for column in range(count + 1)]
        rows.append([(right - left, height // num_rows - BAR_HEIGHT) for left, right in pairwise(edges)])
    return rows


# --- what is shown -------------------------------------------------------------------------------------------------


def _round_frames(
    renderer: SceneRenderer, played: RecordedRound, number: str, stride: int, frame_s: float, step_s: float
) -> Iterator[Image]:
    """Alice moves while Bob waits, then Bob moves, then both rest; ``number`` stands in the caption."""
    faded = (0.45 * renderer.render(played.bob_states[0]) + 0.55 * 235).astype(np.uint8)
    right = _caption(faded, "Bob waits", _FAINT, number)
    for step in _thinned(len(played.alice_states), stride):
        picture = renderer.render(played.alice_states[step])
        yield np.hstack([_caption(picture, "Alice proposes a goal", _ORANGE), right])
    if played.verdict != Verdict.VALID:
        left = _caption(picture, f"Alice: no goal, {NO_GOAL[played.verdict]}", _ORANGE)
        yield from _hold(np.hstack([left, right]), END_PAUSE_S, frame_s)
        return
    left = _caption(picture, "Alice proposed this goal", _INK)
    picture = renderer.render(played.bob_states[0], played.goal)
    yield from _hold(np.hstack([left, _caption(picture, "Bob's turn", _BLUE, number)]), GOAL_PAUSE_S, frame_s)
    for step in _thinned(len(played.bob_states), stride):
        picture = renderer.render(played.bob_states[step], played.goal)
        yield np.hstack([left, _caption(picture, f"Bob tries: {step * step_s:.1f} s", _BLUE, number)])
    text, colour = ("solved after", _GREEN) if played.solved else ("not solved in", _ORANGE)
    ended = _caption(picture, f"Bob: {text} {len(played.bob_actions) * step_s:.1f} s", colour, number)
    yield from _hold(np.hstack([left, ended]), END_PAUSE_S, frame_s)


def _episode_frames(
    renderer: SceneRenderer,
    episodes: RecordedEpisodes,
    panes: list[list[tuple[int, int]]],
    stride: int,
    frame_s: float,
) -> Iterator[Image]:
    num = episodes.states.shape[1]
    steps = _thinned(len(episodes.states), stride)
    for step in track(steps, "drawing the video", len(steps), "pictures"):
        episode, rows = 0, []
        for row in panes:
            pictures = []
            for size in row:
                goal = None if episodes.goal is None else episodes.goal[episode]
                picture = renderer.render(episodes.states[step, episode], goal, size)
                text, colour = ("at the goal", _GREEN) if episodes.reached[step, episode] else ("on the way", _FAINT)
                if goal is None:
                    text = "random skill"
                pictures.append(_caption(picture, text, colour, f"{episode + 1}/{num}" if num > 1 else ""))
                episode += 1
            rows.append(np.hstack(pictures))
        frame = _filled(np.vstack(rows))
        yield frame
    yield from _hold(frame, END_PAUSE_S, frame_s)


def _timing(config: WorldConfig, speed: float) -> tuple[int, float]:
    """How many states a frame stands for, more than 1 where the film is fast, and its seconds."""
    state_s = config.step_s / speed
    stride = max(math.ceil(1 / (MAX_FPS * state_s) - 1e-9), 1)
    return stride, stride * state_s


def _thinned(num: int, stride: int) -> list[int]:
    """Every ``stride``-th of ``num`` indices, and always the last."""
    return [*range(0, num - 1, stride), num - 1]


def _hold(frame: Image, pause_s: float, frame_s: float) -> list[Image]:
    return [frame] * max(round(pause_s / frame_s), 1)


# --- pictures ------------------------------------------------------------------------------------------------------


def _filled(frame: Image) -> Image:
    """A frame with a last line of paper where its height is odd, which H.264 cannot have."""
    return np.pad(frame, ((0, len(frame) % 2), (0, 0), (0, 0)), constant_values=_PAPER[0])


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
