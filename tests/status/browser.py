"""A headless Chromium and the pages it shows."""

from __future__ import annotations

import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from playwright.sync_api import Browser, ConsoleMessage, Dialog, Locator, Page, sync_playwright

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome", "chrome"))), None)
_ARGUMENTS = (
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--no-proxy-server",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--disable-dev-shm-usage",
)
_TIMEOUT_MS = 300_000
_ABOUT_DRAWING = ("GPU stall", "willReadFrequently")
"""What Chromium says of any WebGL without a graphics card."""


@contextmanager
def chromium(*more: str) -> Iterator[Browser]:
    """Start the system's Chromium, with more arguments."""
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=[*_ARGUMENTS, *more])
        yield browser
        browser.close()


class Visit:
    """A page, with its requests and its error messages."""

    def __init__(self, browser: Browser, url: str, **options: Any) -> None:
        self.url = url
        self.context = browser.new_context(**options)
        self.context.set_default_timeout(_TIMEOUT_MS)
        self.page: Page = self.context.new_page()
        self.complaints: list[str] = []
        self.asked: list[str] = []
        self.page.on("request", lambda request: self.asked.append(request.url))
        self.page.on("pageerror", lambda error: self.complaints.append(str(error)))
        self.page.on("console", self._on_console)
        self.page.on("dialog", self._on_dialog)

    def _on_console(self, said: ConsoleMessage) -> None:
        if said.type != "log" and not any(words in said.text for words in _ABOUT_DRAWING):
            self.complaints.append(said.text)

    def _on_dialog(self, dialog: Dialog) -> None:
        self.complaints.append(dialog.message)
        dialog.dismiss()

    def go(self, place: str = "#/") -> Visit:
        """Open a view by its address: the first time like a bookmark, later like a link."""
        self.page.goto(f"{self.url}/{place}")
        return self

    def wait(self, condition: str) -> None:
        """Wait until a JavaScript expression holds; the page's policy for scripts forbids Playwright's own way."""
        deadline_s = time.monotonic() + _TIMEOUT_MS / 1000
        while not self.page.evaluate(condition):
            assert time.monotonic() < deadline_s, condition
            self.page.wait_for_timeout(30)

    def chart(self, title: str) -> Locator:
        """The panel with a title."""
        return self.page.locator("figure.chart").filter(has=self.page.get_by_role("heading", name=title, exact=True))

    def traces(self, name: str, run: str = "cube") -> list[dict[str, Any]]:
        """What is drawn of a metric of a run: its values and, where there are, its smooth ones; x and y each."""
        found: list[dict[str, Any]] = self.page.evaluate(
            """name => [...document.querySelectorAll('.canvas')].flatMap(canvas => canvas.data ?? [])
                .filter(trace => trace.name === name)
                .map(({x, y, fill}) => ({x: [...x], y: [...y], fill}))""",
            f"{run} {name}",
        )
        return found

    def points(self, name: str, number: int, run: str = "cube") -> list[tuple[float, float | None]]:
        """Wait until a curve has a number of points, and give them: (env steps, value) each."""
        deadline_s = time.monotonic() + _TIMEOUT_MS / 1000
        while True:
            found = self.traces(name, run)
            if found and len(found[0]["x"]) == number:
                return list(zip(found[0]["x"], found[0]["y"], strict=True))
            assert time.monotonic() < deadline_s, (name, found)
            self.page.wait_for_timeout(30)
