"""Frames to a file by ffmpeg: H.264 in an mp4, or a GIF; the file takes its name only when it is whole."""

from __future__ import annotations

import contextlib
import errno
import itertools
import os
import subprocess
from collections.abc import Iterator
from pathlib import Path

from service.base.errors import TandemError
from service.base.files import TEMPORARY_PREFIX, os_errors
from service.base.liveness import count_work
from service.envs.rendering.renderer import Image

_H264 = ("-c:v", "libx264", "-pix_fmt", "yuv420p", "-crf", "21", "-preset", "veryfast", "-movflags", "+faststart")
# One palette for all frames, and a regular pattern where a colour is not in it: frames that hardly change stay small.
_GIF = ("-vf", "split[a][b];[a]palettegen=stats_mode=diff[p];[b][p]paletteuse=dither=bayer:bayer_scale=5")
FORMATS = {".mp4": (*_H264, "-f", "mp4"), ".gif": (*_GIF, "-loop", "0", "-f", "gif")}
"""Options of ffmpeg by the end of a file's name."""


def check_format(path: Path) -> tuple[str, ...]:
    """Options of ffmpeg for that file.

    Raises:
        TandemError: no film has a name that ends so.
    """
    if path.suffix.lower() not in FORMATS:
        raise TandemError(f"{path}: a film ends in {' or '.join(FORMATS)}; name such a file")
    return FORMATS[path.suffix.lower()]


def encode(frames: Iterator[Image], path: Path, *, fps: float) -> Path:
    """Write frames, all of one even size.

    Raises:
        TandemError: no ffmpeg here, no such format, the disk is full, or the file cannot be written.
    """
    options = check_format(path)
    temporary = path.parent / f"{TEMPORARY_PREFIX}{os.getpid()}-{path.name}"
    with os_errors("write", path):
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            _run_ffmpeg(frames, temporary, fps, options)
            temporary.replace(path)
        finally:
            temporary.unlink(missing_ok=True)
    return path


def _run_ffmpeg(frames: Iterator[Image], path: Path, fps: float, options: tuple[str, ...]) -> None:
    """Send frames to ffmpeg.

    ``imageio_ffmpeg.write_frames`` would be shorter, but ignores ffmpeg's exit status: a full disk would go unnoticed.
    """
    first = next(frames)
    height, width = first.shape[:2]
    command = [
        _ffmpeg(), "-y", "-loglevel", "error", "-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}",
        "-r", f"{fps:g}", "-i", "pipe:", *options, f"file:{path}",
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
        raise TandemError("cannot write a video: there is no ffmpeg; install it (apt-get install ffmpeg)") from None
