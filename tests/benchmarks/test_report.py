"""The committed pages and pictures are what their recorded files give, and their words by hand do not go beyond."""

import hashlib
import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import service
from benchmarks.measuring import RECIPE_FILE
from benchmarks.report.__main__ import ABOUT_THE_RECIPE, PAGES, Report, begin, end, replace_blocks
from benchmarks.report.recipe import SHIPPED, check_words, differences, recipe_words
from benchmarks.reproduce import RESULTS
from service.base.errors import TandemError
from service.config import load_config
from service.registry.digest import parameters_digest

DOCS = Path(__file__).parents[2] / "docs"


class FirstOfEachKind(Report):
    """Of several pictures of one kind it draws the first."""

    kinds = ()

    def show(self, words, name, draw, recorded):
        if draw in self.kinds:
            return f"![{words}]({name}.png)"
        self.kinds = (*self.kinds, draw)
        return super().show(words, name, draw, recorded)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A copy of the documents with what the report writes made anew; the report."""
    docs = tmp_path_factory.mktemp("report") / "docs"
    shutil.copytree(DOCS, docs, ignore=shutil.ignore_patterns("primitives"))
    shutil.copy(DOCS.parent / "README.md", docs.parent)
    report = FirstOfEachKind(docs)
    report.write()
    return docs, report


@pytest.mark.parametrize("page", [*PAGES, "results/downstream.md"])
def test_the_committed_page_is_what_the_recorded_files_give(made, page):
    assert (made[0] / page).read_text() == (DOCS / page).read_text()


def test_the_committed_pictures_show_what_the_recorded_files_give(made):
    pictures = [path for path in made[1].files if path.suffix == ".png"]
    assert len(pictures) == 9
    for picture in pictures:
        ours, theirs = (
            np.asarray(Image.open(path).convert("RGB"), dtype=np.int16)
            for path in (picture, DOCS / "results" / picture.name)
        )
        assert ours.shape == theirs.shape, picture.name
        # another version of the fonts may move the edges of letters
        assert np.mean(np.abs(ours - theirs).max(axis=2) > 64) < 0.005, picture.name


def test_blocks_are_replaced_between_their_markers(tmp_path):
    page = tmp_path / "page.md"
    page.write_text(f"a {begin('box')} old {end('box')} b")
    assert replace_blocks(page, {"box": ""}) == f"a {begin('box')}\n\nNot recorded yet.\n\n{end('box')} b"
    with pytest.raises(TandemError, match="no markers for chaos"):
        replace_blocks(page, {"box": "new", "chaos": "text"})


# --- words by hand ----------------------------------------------------------------------------------------------------

STUDY = json.loads((DOCS / "results" / "time_to_skill.json").read_text())
SHIPS = load_config(RECIPE_FILE).model_dump(mode="json")


def study_of(recipe):
    return STUDY | {"settings": STUDY["settings"] | {"recipe": recipe}}


def test_a_page_that_says_the_shipped_recipe_is_not_made_where_another_one_was_recorded(tmp_path):
    docs, page = tmp_path / "docs", ABOUT_THE_RECIPE[-1]
    shutil.copytree(DOCS, docs, ignore=shutil.ignore_patterns("*.png", "primitives"))
    shutil.copy(DOCS.parent / "README.md", tmp_path)
    recorded = docs / "results" / "time_to_skill.json"
    recipe = SHIPS | {"policy": SHIPS["policy"] | {"bob": SHIPS["policy"]["bob"] | {"num_primitives": 5}}}
    recorded.write_text(json.dumps(study_of(recipe)))
    (docs / page).write_text((docs / page).read_text() + "\nIt is The\nshipped recipe.\n")
    with pytest.raises(TandemError, match=rf"{page}: it says '{SHIPPED}', .* policy\.bob\.num_primitives;"):
        Report(docs).write()


def test_other_pages_of_results_do_not_say_of_which_recipe_they_are():
    """Of these the recipe is compared; logs say what it was then."""
    pages = [DOCS.parent / "README.md", *DOCS.glob("results/*.md")]
    said = {page.name for page in pages if SHIPPED in " ".join(page.read_text().lower().split())}
    assert said <= {Path(page).name for page in ABOUT_THE_RECIPE} | {"log.md"}


def test_which_recipe_a_time_to_skill_was_measured_with():
    same = study_of(SHIPS | {"seed": 7, "name": "other", "run": SHIPS["run"] | {"total_env_steps": 5}})
    assert differences(same["settings"]["recipe"]) == {}
    assert recipe_words(same).endswith(f", with {SHIPPED}.")
    check_words(Path("page.md"), f"this is {SHIPPED}", same)
    other = study_of(SHIPS | {"learner": SHIPS["learner"] | {"bob_ema_decay": 0.5}})
    assert differences(other["settings"]["recipe"]) == {"learner.bob_ema_decay": (0.5, 0.998)}
    assert recipe_words(other).endswith(
        "**The recipe was another one than today's**: `learner.bob_ema_decay` 0.5 (today 0.998)."
    )


def test_an_option_that_is_gone_is_told_of_a_run_that_had_it_on():
    for had, told in ((True, {"generator.replay_over_cells": (True, False)}), (False, {})):
        assert differences(SHIPS | {"generator": SHIPS["generator"] | {"replay_over_cells": had}}) == told


def test_the_digest_that_a_page_calls_the_champion_is_the_bundled_ones():
    digest = parameters_digest(service.load("panda-cube@champion", registry="no registry here").primitives)
    page = (DOCS / "results" / "pretraining.md").read_text()
    ((seed, words),) = re.findall(
        r"`panda-cube@champion`, in the package, is version \d+, seed (\d+) of the table above: (.*)", page
    )
    assert f"parameters `{digest[:12]}`" in words
    of_the_seed = service.load(f"panda-cube@seed-{seed}", registry=RESULTS / "primitives")
    assert parameters_digest(of_the_seed.primitives) == digest  # seed 0 of the table rests on it


def without_blocks(page):
    text = (DOCS / page).read_text()
    # blocks of before are no words by hand, either
    return re.sub(r"<!-- (\w+): begin, .*?<!-- \1: end -->", "", text, flags=re.DOTALL)


def test_every_rate_of_a_table_in_the_readme_has_its_number_of_seeds():
    lines = (DOCS.parent / "README.md").read_text().splitlines()
    rows = [line.strip("|").split("|")[1:] for line in lines if line.startswith("|")]
    rates = [cell.strip(" *") for row in rows for cell in row if re.search(r"\d %", cell)]
    assert len(rates) == 5 * 6
    assert [rate for rate in rates if not re.fullmatch(r"\d+ % \([1-9]\d*\)", rate)] == []


def test_the_readme_says_how_many_checks_of_the_deployment_there_were_and_all_passed():
    checks = json.loads((DOCS / "results" / "deployed.json").read_text())["checks"]
    assert f"[{len(checks)} checks](docs/results/deployed.md)" in (DOCS.parent / "README.md").read_text()
    assert [check["name"] for check in checks if check["outcome"] != "passed"] == []


@pytest.mark.parametrize("page", [*(page for page in PAGES if page.startswith("results/")), "results/robust.md"])
def test_words_by_hand_have_no_rates_of_their_own(page):
    asked = re.compile("9[05] %")  # what was asked for, and how sure an interval is, are no results
    lines = [line for line in without_blocks(page).splitlines() if re.search(r"\d %", asked.sub("", line))]
    assert lines == []


def test_blocks_that_were_said_once_still_say_what_their_files_say():
    """Their programs are gone: whoever changes such a block or its files has to look at the other."""
    found = 0
    for page in sorted(DOCS.rglob("*.md")):
        marked = r"<!-- (\w+): begin, said once of (.*?) \(sha256 (\w+)\) -->(.*?)<!-- \1: end -->"
        for name, patterns, digest, block in re.findall(marked, page.read_text(), re.DOTALL):
            said = hashlib.sha256(block.strip().encode())
            for pattern in patterns.split():
                files = sorted((DOCS / "results").glob(pattern))
                assert files, (page, pattern)
                for file in files:
                    said.update(file.read_bytes())
            assert said.hexdigest().startswith(digest), (page.name, name)
            found += 1
    assert found == 15
