"""The docs site: ``python -m tools.docs_site`` builds it from ``docs/``. A link to nothing is an error.

Pages link to each other as they lie in the repository. Here they are copied to one place, with links that fit there: to
another page, to a picture or a recorded result. A source file is no part of the site, and is named by its path.
"""

from __future__ import annotations

import argparse
import re
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from benchmarks.measuring import ROOT, one_line_errors
from service.base.errors import TandemError

OUTSIDE = {"CHANGELOG.md": "changelog.md", "CONTRIBUTING.md": "contributing.md", "deploy/README.md": "deploy.md"}
"""Pages of the site that do not lie in ``docs/``."""
NOT_PAGES = {"README.md": "index.md"}
"""What stands for a document that is no page."""
_LINK = re.compile(r"(!?)\[((?:[^\[\]]|\[[^\]]*\])*)\]\(([^()\s]+)\)")
_CODE = re.compile(r"(^ *```.*?^ *```|`[^`\n]+`(?!\]))", re.DOTALL | re.MULTILINE)


def build(out: Path, root: Path = ROOT) -> Path:
    """Build the site of a checkout.

    Args:
        out: directory for it; emptied first.
        root: of the checkout.

    Returns:
        Directory with ``index.html``.
    """
    shutil.rmtree(out, ignore_errors=True)
    stage(out, root)
    command = [sys.executable, "-m", "zensical", "build", "--strict", "--config-file", str(out / "zensical.toml")]
    try:
        done = subprocess.run(command, cwd=out, capture_output=True, text=True, timeout=600)
    except subprocess.TimeoutExpired:
        raise TandemError("zensical did not end within 10 minutes") from None
    if done.returncode:
        said = re.sub(r"\x1b\[[0-9;]*m", "", done.stdout + done.stderr)
        raise TandemError(f"zensical --strict failed; it said:\n{said}")
    return out / "site"


def stage(out: Path, root: Path = ROOT) -> None:
    """Write what the generator reads: pages, the files they link to, its settings."""
    places = {root / source: page for source, page in OUTSIDE.items()}
    places |= {path: str(path.relative_to(root / "docs")) for path in sorted((root / "docs").rglob("*.md"))}
    texts = {page: (path, path.read_text(encoding="utf-8")) for path, page in places.items()}
    for page, (source, text) in texts.items():
        target = out / "docs" / page
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_text(_relinked(text, source, page, places, root, out / "docs"), encoding="utf-8")
    settings = (root / "docs" / "zensical.toml").read_text(encoding="utf-8")
    (out / "zensical.toml").write_text(_with_navigation(settings, set(texts)), encoding="utf-8")


def _relinked(text: str, source: Path, page: str, known: dict[Path, str], root: Path, out: Path) -> str:
    """A page's text with links that fit the site; what it shows is copied."""
    up = "../" * page.count("/")

    def link(match: re.Match[str]) -> str:
        sign, words, target = match.groups()
        if "://" in target or target.startswith(("#", "mailto:")):
            return match[0]
        name, _, anchor = target.partition("#")
        path = (source.parent / name).resolve()
        anchor = f"#{anchor}" if anchor else ""
        if path in known:
            return f"{sign}[{words}]({up}{known[path]}{anchor})"
        if not path.exists() or not path.is_relative_to(root):
            raise TandemError(f"{source.relative_to(root)}: link to {target}, which is not there")
        inside = str(path.relative_to(root))
        if inside in NOT_PAGES:
            return f"[{words}]({up}{NOT_PAGES[inside]})"
        if path.is_file() and path.is_relative_to(root / "docs"):
            copy = out / path.relative_to(root / "docs")
            copy.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(path, copy)
            return f"{sign}[{words}]({up}{path.relative_to(root / 'docs')})"
        return words if inside in words else f"{words} (`{inside}`)"

    parts = _CODE.split(text)
    return "".join(part if index % 2 else _LINK.sub(link, part) for index, part in enumerate(parts))


def _with_navigation(settings: str, pages: set[str]) -> str:
    """The settings with every ``*`` of the navigation spelled out: the pages that are not named by themselves."""

    def spelled(match: re.Match[str]) -> str:
        found = sorted(page for page in pages if Path(page).match(match[1]) and f'"{page}"' not in settings)
        return ", ".join(f'"{page}"' for page in found)

    text = re.sub(r'"([^"\n]*\*[^"\n]*\.md)"', spelled, settings)
    named = list(_names(tomllib.loads(text)["project"]["nav"]))
    if missing := sorted(set(named) - pages):
        raise TandemError(f"docs/zensical.toml: no such page: {', '.join(missing)}")
    if absent := sorted(pages - set(named)):
        raise TandemError(f"docs/zensical.toml: add to nav: {', '.join(absent)}")
    return text


def _names(nav: Any) -> Iterator[str]:
    """Every page in a navigation."""
    if isinstance(nav, str):
        yield nav
    else:
        for each in nav.values() if isinstance(nav, dict) else nav:
            yield from _names(each)


@one_line_errors
def main() -> int:
    """Entry point of ``python -m tools.docs_site``."""
    parser = argparse.ArgumentParser(description="Build the docs site.")
    parser.add_argument("--out", type=Path, default=ROOT / "build" / "docs-site", help="directory; emptied first")
    print(f"{build(parser.parse_args().out.resolve()) / 'index.html'}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
