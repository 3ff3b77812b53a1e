"""The notebooks of the docs, run from top to bottom with small numbers."""

import json
from pathlib import Path

import matplotlib
import pytest

NOTEBOOKS = sorted((Path(__file__).parents[1] / "docs" / "notebooks").glob("*.ipynb"))
SMALL = {"ENV_STEPS": 7_000, "GOALS": 2, "EPISODES": 4, "SKILLS": 4}


def code_of(notebook):
    """Its cells of code, with the numbers of the first one made small."""
    cells = [each for each in json.loads(notebook.read_text())["cells"] if each["cell_type"] == "code"]
    assert cells[0]["metadata"]["tags"] == ["parameters"]
    names = "".join(cells[0]["source"]).partition(" = ")[0].split(", ")
    first = "\n".join(f"{name} = {SMALL[name]}" for name in names)
    return [first, *("".join(each["source"]) for each in cells[1:])]


@pytest.mark.usefixtures("default_signals", "no_artifacts")
@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs(notebook, tmp_path, monkeypatch):
    matplotlib.use("agg")
    monkeypatch.chdir(tmp_path)
    scope = {}
    for cell in code_of(notebook):
        exec(compile(cell, notebook.name, "exec"), scope)


def test_nothing_of_a_run_is_kept_in_them():
    for notebook in NOTEBOOKS:
        for cell in json.loads(notebook.read_text())["cells"]:
            assert not cell.get("outputs")
    assert len(NOTEBOOKS) == 3
