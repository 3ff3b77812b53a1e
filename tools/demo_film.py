"""A recording of the demo as a newcomer sees it: the page in Chromium, where the goal is dragged with the mouse.

    python -m tools.demo_film --seed 40 --out docs/images/demo.gif

Nothing is cut. Every picture shows the time since the demo began. A JSON says, for every drag, what the page
said of the object some seconds later. Without a graphics card Chromium takes about a core to draw, so
learning is slower than without it.
"""

from __future__ import annotations

import argparse
import io
import json
import queue
import re
import subprocess
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from shutil import which
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from benchmarks.demo import lines_of, tandem
from benchmarks.measuring import ROOT, machine, one_line_errors, write_json
from benchmarks.training_process import scratch
from service.base.errors import TandemError
from service.media.encoding import encode

SIZE = (960, 540)
SHOWN = (640, 360)
"""Of the recording."""
PANEL_LEFT = 620
"""Where the controls begin, pixels."""
ARROWS = {"x": (249, 45, 104), "y": (120, 216, 155), "z": (54, 142, 226)}
"""Colours of the arrows by which the goal is dragged, as they are drawn."""
LONGEST = 90
"""Of an arrow, pixels: what is larger is something else of that colour."""
DRAG_S, ARRIVE_S = 20.0, 6.0
"""Between two drags, and until it is looked at what came of one."""
PICTURES_A_SECOND = 10.0
_ADDRESS = re.compile(r"watch it at (http://[\d.]+:\d+)")
_CAPTION = re.compile("^(At the goal|On the way|Not there|the object fell)")


@dataclass(slots=True)
class Film:
    """Pictures with their clock, and what came of each drag."""

    begun_s: float
    pictures: list[Image.Image] = field(default_factory=list)
    drags: list[dict[str, Any]] = field(default_factory=list)

    def take(self, page: Any) -> NDArray[np.uint8]:
        """Add what the page shows."""
        picture = Image.open(io.BytesIO(page.screenshot())).convert("RGB")
        found = np.array(picture)
        small = picture.resize(SHOWN, Image.Resampling.LANCZOS)
        draw, seconds = ImageDraw.Draw(small), int(time.monotonic() - self.begun_s)
        draw.rectangle((8, SHOWN[1] - 34, 92, SHOWN[1] - 8), fill=(20, 20, 20))
        draw.text(
            (16, SHOWN[1] - 32), f"{seconds // 60}:{seconds % 60:02d}", fill="white", font=ImageFont.load_default(20)
        )
        self.pictures.append(small)
        return found


def arrow(picture: NDArray[np.uint8], axis: str) -> NDArray[np.float64] | None:
    """(2, 2) pixels (x, y) on an arrow: about its middle, and its end further from the other arrows; None: hidden."""
    found = {each: _pixels(picture, color) for each, color in ARROWS.items()}
    points, others = found[axis], np.concatenate([found[each] for each in ARROWS if each != axis])
    if len(points) < 12 or not len(others) or np.ptp(points, axis=0).max() > LONGEST:
        return None
    middle = points[np.argmin(np.linalg.norm(points - points.mean(axis=0), axis=1))]
    return np.stack((middle, points[np.argmax(np.linalg.norm(points - others.mean(axis=0), axis=1))]))


def _pixels(picture: NDArray[np.uint8], color: tuple[int, int, int]) -> NDArray[np.float64]:
    """(M, 2) pixels (x, y) of a colour, left of the panel."""
    row, column = np.nonzero(np.abs(picture[:, :PANEL_LEFT].astype(int) - color).sum(axis=2) < 20)
    return np.stack((column, row), axis=1).astype(float)


def drag(page: Any, picture: NDArray[np.uint8], axis: str, pixels: float) -> bool:
    """Drag an arrow along itself with the mouse; False where it is hidden."""
    found = arrow(picture, axis)
    if found is None:
        return False
    (x, y), (tip_x, tip_y) = found
    way = np.array((tip_x - x, tip_y - y))
    way *= pixels / max(float(np.linalg.norm(way)), 1.0)
    page.mouse.move(x, y)
    page.mouse.down()
    for share in (0.25, 0.5, 0.75, 1.0):
        page.mouse.move(x + share * way[0], y + share * way[1])
        page.wait_for_timeout(60)
    page.mouse.up()
    page.mouse.move(PANEL_LEFT - 60, SIZE[1] - 30)
    return True


def record(seed: int, minutes: float, out: Path) -> dict[str, Any]:
    """Run the demo, drag its goal, and write the recording; for JSON."""
    from playwright.sync_api import sync_playwright

    said: queue.SimpleQueue[str | None] = queue.SimpleQueue()
    film, rng = Film(time.monotonic()), np.random.default_rng(seed)
    with scratch() as home, sync_playwright() as playwright:
        demo = tandem(home, "demo", "--seed", str(seed), "--run-dir", "demo", "--minutes", str(minutes))
        threading.Thread(target=_listen, args=(demo, said), daemon=True).start()
        try:
            address = next(found[1] for line in _until_end(said) if (found := _ADDRESS.search(line)))
            browser = playwright.chromium.launch(
                executable_path=which("chromium") or which("google-chrome"), args=["--no-sandbox", "--disable-gpu"]
            )
            page = browser.new_page(viewport={"width": SIZE[0], "height": SIZE[1]})
            page.set_default_timeout(60_000)
            _open(page, address)
            last_s, waiting = time.monotonic(), False
            while demo.poll() is None:
                picture = film.take(page)
                now_s = time.monotonic()
                if waiting and now_s - last_s >= ARRIVE_S:
                    film.drags[-1]["seen"] = page.get_by_text(_CAPTION).first.text_content()
                    film.drags[-1]["after_s"] = round(now_s - last_s, 1)
                    waiting = False
                if now_s - last_s >= DRAG_S:
                    axis, pixels = str(rng.choice(list(ARROWS))), float(rng.choice((-1, 1)) * rng.uniform(40, 110))
                    if drag(page, picture, axis, pixels):
                        film.drags.append(
                            {"at_s": round(now_s - film.begun_s, 1), "axis": axis, "pixels": round(pixels)}
                        )
                        last_s, waiting = time.monotonic(), True
        except Exception as error:
            if demo.poll() is None:  # else the page went with the demo, which is how this ends
                raise TandemError(f"the recording stopped: {error}") from error
        finally:
            demo.terminate()
            demo.wait()
        lines = list(_until_end(said))
    encode((np.array(each) for each in film.pictures), out, fps=PICTURES_A_SECOND)
    ended = [line.strip() for line in lines if "random goals" in line or "are over" in line]
    return {
        "benchmark": "demo_film", "machine": machine(), "seed": seed, "said": ended, "pictures": len(film.pictures),
        "seconds": round(time.monotonic() - film.begun_s), "drags": [each for each in film.drags if "seen" in each],
    }  # fmt: skip


def _listen(demo: subprocess.Popen[str], said: queue.SimpleQueue[str | None]) -> None:
    with suppress(TandemError):  # it is ended where the recording fails
        for line in lines_of(demo):
            said.put(line)
    said.put(None)


def _until_end(said: queue.SimpleQueue[str | None]) -> Iterator[str]:
    while (line := said.get(timeout=600)) is not None:
        yield line


def _open(page: Any, address: str) -> None:
    """Open the page, and hide what it says of a machine without a graphics card."""
    page.goto(address)
    page.get_by_text("Who acts").first.wait_for()
    page.add_style_tag(content=".mantine-Notifications-root { display: none }")


@one_line_errors
def main() -> int:
    """Entry point of ``python -m tools.demo_film``."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=40)
    parser.add_argument("--minutes", type=float, default=8.0)
    parser.add_argument("--out", type=Path, required=True, help="a GIF, or an MP4")
    parser.add_argument("--json", type=Path, default=ROOT / "docs" / "results" / "demo_film.json")
    given = parser.parse_args()
    result = record(given.seed, given.minutes, given.out)
    write_json(given.json, result)
    print(json.dumps(result["drags"], indent=1))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
