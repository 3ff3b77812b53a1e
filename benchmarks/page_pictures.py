"""Pictures of the web page, taken in the system's Chromium of real runs: those in the documents.

    python -m benchmarks.page_pictures --runs runs --registry runs/registry --run cube-1 --out docs/images

Runs and registry are only read.
"""

from __future__ import annotations

import argparse
import shutil
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from PIL import Image
from playwright.sync_api import Browser, Page, sync_playwright

from service.errors import TandemError
from service.registry.registry import Registry
from service.status.server import StatusServer
from service.store.disk_reader import DiskReader

CHROMIUM = ("chromium", "chromium-browser", "google-chrome", "chrome")
ARGUMENTS = ["--headless", "--no-sandbox", "--disable-gpu", "--no-first-run", "--no-proxy-server"]
SETTLE_MS = 1500


@dataclass(frozen=True, slots=True)
class Picture:
    """One view at one size."""

    name: str
    width: int
    """CSS pixels, as is the height."""
    height: int
    scheme: Literal["light", "dark"]
    scale: float = 1.0
    from_heading: str | None = None
    """Scrolled down to this one."""


PICTURES = (
    Picture("status-light.png", 1200, 1330, "light", scale=1.25),
    Picture("status-dark.png", 1200, 1000, "dark", scale=1, from_heading="Newest video"),
    Picture("status-phone.png", 360, 900, "light", scale=2),
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Take all pictures; the exit code."""
    parser = argparse.ArgumentParser(description="Take the pictures of the web page.")
    parser.add_argument("--runs", type=Path, default=Path("runs"), help="directory of run directories")
    parser.add_argument("--registry", type=Path, default=Path("registry"))
    parser.add_argument("--run", help="id of the run to show; the newest when left out")
    parser.add_argument("--out", type=Path, default=Path("docs/images"))
    options = parser.parse_args(arguments)
    try:
        take_all(options.runs, options.registry, options.run, options.out)
    except TandemError as error:
        print(f"error: {error}", file=sys.stderr)
        return error.exit_code
    return 0


def take_all(runs: Path, registry: Path, run_id: str | None, out: Path) -> None:
    """Serve the runs, and write every picture into ``out``.

    Raises:
        TandemError: there is no Chromium, or no run to show.
    """
    found = next(filter(None, map(shutil.which, CHROMIUM)), None)
    if found is None:
        raise TandemError(f"no {CHROMIUM[0]} on PATH; on Debian: apt-get install {CHROMIUM[0]}")
    reader = DiskReader(runs)
    there = [run.run_id for run in reader.runs()]
    if not there or (run_id or there[0]) not in there:
        raise TandemError(f"no run {run_id or ''} in {runs}; it holds: {', '.join(there) or 'none'}")
    out.mkdir(parents=True, exist_ok=True)
    with StatusServer(reader, Registry(registry), port=0, runs_dir=runs) as server, sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=found, args=ARGUMENTS)
        for picture in PICTURES:
            take(browser, f"{server.url}/#/runs/{run_id or there[0]}", picture, out / picture.name)
        browser.close()


def take(browser: Browser, url: str, picture: Picture, path: Path) -> None:
    """Write one picture."""
    context = browser.new_context(
        viewport={"width": picture.width, "height": picture.height},
        color_scheme=picture.scheme,
        device_scale_factor=picture.scale,
    )
    page = context.new_page()
    page.goto(url)
    _settle(page, picture)
    page.screenshot(path=path)
    context.close()
    # without the k-means, what is rare gets no colour of its own: the red cube in the video
    Image.open(path).convert("RGB").quantize(256, kmeans=4, dither=Image.Dither.NONE).save(path, optimize=True)
    print(f"{path}: {path.stat().st_size // 1000} kB")


def _settle(page: Page, picture: Picture) -> None:
    page.locator("figure.chart path.smooth").first.wait_for()
    page.get_by_role("table").first.wait_for()
    page.locator(".media video, .media .note").first.wait_for()
    if picture.from_heading:
        top = page.get_by_role("heading", name=picture.from_heading).bounding_box()
        assert top is not None
        page.evaluate(f"scrollTo(0, {top['y'] - 24})")
    page.wait_for_timeout(SETTLE_MS)


if __name__ == "__main__":
    sys.exit(main())
