"""The notebooks of the docs, run from top to bottom with small numbers."""

import json
from pathlib import Path

import matplotlib
import pytest

NOTEBOOKS = sorted((Path(__file__).parents[1] / "docs" / "notebooks").glob("*.ipynb"))
SMALL = {"ENV_STEPS": 1_000, "GOALS": 2, "EPISODES": 4, "SKILLS": 4}
SMALL_SAC = ("num_worlds=4", "learning_starts=400", "batch_size=32", "gradient_steps=1")
FEWER = {
    '"run.evaluation_interval=25"': ("run.evaluation_interval=1", "run.final_episodes=2", "game.num_worlds=4"),
    'f"run.final_episodes={EPISODES}"': ("run.final_episodes=4", *(f"sac.{each}" for each in SMALL_SAC)),
    '"name=bounded"': ("name=bounded", "skills.batch_size=32", *(f"skills.sac.{each}" for each in SMALL_SAC)),
}
"""Settings that a cell has, and smaller ones that take its place."""


def code_of(notebook):
    """Its cells of code, with the numbers of the first one and settings of others made small."""
    cells = [each for each in json.loads(notebook.read_text())["cells"] if each["cell_type"] == "code"]
    assert cells[0]["metadata"]["tags"] == ["parameters"]
    names = "".join(cells[0]["source"]).partition(" = ")[0].split(", ")
    first = "\n".join(f"{name} = {SMALL[name]}" for name in names)
    rest = "\n# ---\n".join("".join(each["source"]) for each in cells[1:])
    assert sum(rest.count(setting) for setting in FEWER) == 1
    for setting, smaller in FEWER.items():
        rest = rest.replace(setting, ", ".join(f'"{each}"' for each in smaller))
    return [first, *rest.split("\n# ---\n")]


@pytest.mark.usefixtures("default_signals", "no_artifacts")
@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs(notebook, tmp_path, monkeypatch):
    matplotlib.use("agg")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("service.methods.task_check._NUM_WORLDS", 8)
    scope = {}
    for cell in code_of(notebook):
        exec(compile(cell, notebook.name, "exec"), scope)


def test_nothing_of_a_run_is_kept_in_them():
    for notebook in NOTEBOOKS:
        for cell in json.loads(notebook.read_text())["cells"]:
            assert not cell.get("outputs")
    assert len(NOTEBOOKS) == 3
