"""The committed pages and pictures are what their recorded files give."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from benchmarks.report.__main__ import PAGES, Report

DOCS = Path(__file__).parents[2] / "docs"


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A copy of the documents with all that the report writes made anew."""
    docs = tmp_path_factory.mktemp("report") / "docs"
    shutil.copytree(DOCS, docs)
    shutil.copy(DOCS.parent / "README.md", docs.parent)
    Report(docs).write()
    return docs


@pytest.mark.parametrize("page", [*PAGES, "results/downstream.md"])
def test_the_committed_page_is_what_the_recorded_files_give(made, page):
    assert (made / page).read_text() == (DOCS / page).read_text()


def test_the_committed_pictures_show_what_the_recorded_files_give(made):
    pictures = sorted((made / "results").glob("*.png"))
    assert len(pictures) == 25
    for picture in pictures:
        ours, theirs = (
            np.asarray(Image.open(path).convert("RGB"), dtype=np.int16)
            for path in (picture, DOCS / "results" / picture.name)
        )
        assert ours.shape == theirs.shape, picture.name
        # another version of the fonts may move the edges of letters
        assert np.mean(np.abs(ours - theirs).max(axis=2) > 64) < 0.005, picture.name
