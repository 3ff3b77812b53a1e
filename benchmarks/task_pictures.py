"""Draw the six downstream tasks, as the paper's figure does, for the documents.

    python -m benchmarks.task_pictures --out docs/images/tasks.png

The red object is at its start, the transparent one at its goal. Orange is where objects may start, green where goals
may be.
"""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from service.envs import fixtures
from service.envs.gym.tabletop import TabletopEnv, TabletopState
from service.envs.rendering.renderer import Camera, Mark, RenderError, SceneRenderer
from service.envs.tasks import TASKS, Task

WIDTH, HEIGHT, CAPTION = 480, 390, 48
COLUMNS = 3
CAMERA = Camera((-0.13, 0.0, 0.13), 1.55, 146.0, -33.0)
START_RGBA, GOAL_RGBA, VOLUME_RGBA = (1.0, 0.55, 0.05, 0.45), (0.15, 0.72, 0.25, 0.4), (0.15, 0.72, 0.25, 0.07)
SEEDS = {"larger": 4, "inair": 6, "push": 3, "sphere": 5, "wall": 1, "box": 0}
_THIN_M, _INSET_M = 0.002, 0.02
INK, FAINT = (30, 33, 38), (110, 115, 122)


def draw_task(name: str, seed: int) -> NDArray[np.uint8]:
    """(H, W, 3) a start of one task."""
    env = TabletopEnv(task=name)
    env.reset(seed=seed)
    state = env.state()
    with SceneRenderer(env.config, WIDTH, HEIGHT, CAMERA) as renderer:
        image = renderer.render(state.world, state.goal, _areas(TASKS[name], env, state))
    env.close()
    return image


def _areas(task: Task, env: TabletopEnv, state: TabletopState) -> list[Mark]:
    """Where the object may start and where the goal may be."""
    workspace, object_m = env.config.workspace, env.config.object_size_m
    low, high = np.array(workspace.lower_m[:2]), np.array(workspace.upper_m[:2])
    if env.config.fixture == "wall":
        center_x = workspace.center_x_m
        near = fixtures.WALL_THICKNESS_M / 2 + fixtures.GAP_M + object_m / 2
        sides = [
            (center_x + near, center_x + near + fixtures.AREA_LENGTH_M),
            (center_x - near - fixtures.AREA_LENGTH_M, center_x - near),
        ]
        goal, start = sides if state.goal[0] > center_x else sides[::-1]
        return [
            _flat((start[0], low[1]), (start[1], high[1]), START_RGBA),
            _flat((goal[0], low[1]), (goal[1], high[1]), GOAL_RGBA),
        ]
    marks = [_flat(low, high, START_RGBA)]
    if task.air_share > 0:
        volume = (*low, 2 * _THIN_M), (*high, workspace.height_m)
        marks.append(Mark(*volume, VOLUME_RGBA))
    elif env.config.fixture == "box":
        inner = fixtures.BOX_SIZE_M / 2 - fixtures.BOX_SHELL_M
        marks.append(_flat(state.goal[:2] - inner, state.goal[:2] + inner, GOAL_RGBA, fixtures.BOX_SHELL_M))
    else:
        marks.append(_flat(low + _INSET_M, high - _INSET_M, GOAL_RGBA, _THIN_M))
    return marks


def _flat(low: Any, high: Any, rgba: tuple[float, float, float, float], bottom_m: float = 0.0) -> Mark:
    return Mark((low[0], low[1], bottom_m), (high[0], high[1], bottom_m + _THIN_M), rgba)


def draw_tasks(path: Path) -> None:
    """Draw all six into one picture."""
    rows = -(-len(TASKS) // COLUMNS)
    sheet = Image.new("RGB", (COLUMNS * WIDTH, rows * (HEIGHT + CAPTION)), "white")
    pen = ImageDraw.Draw(sheet)
    title, words = ImageFont.load_default(22), ImageFont.load_default(14)
    for place, (name, task) in enumerate(TASKS.items()):
        left, top = place % COLUMNS * WIDTH, place // COLUMNS * (HEIGHT + CAPTION)
        panel = Image.fromarray(draw_task(name, SEEDS[name])).crop((2, 0, WIDTH - 2, HEIGHT))
        sheet.paste(panel, (left + 2, top))
        pen.text((left + WIDTH / 2, top + HEIGHT + 4), task.title, INK, title, anchor="ma")
        pen.text((left + WIDTH / 2, top + HEIGHT + 26), task.description, FAINT, words, anchor="ma")
    path.parent.mkdir(parents=True, exist_ok=True)
    # the last two bits of a colour are a third of the file, and a palette of 256 has no room for the transparent goals
    sheet.point(lambda value: value | 3).save(path, optimize=True)


def main() -> int:
    """Parse the command line and draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, metavar="FILE", default=Path("docs/images/tasks.png"))
    given = parser.parse_args()
    try:
        draw_tasks(given.out)
    except RenderError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(f"{given.out}: {os.path.getsize(given.out) / 1000:.0f} kB")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
