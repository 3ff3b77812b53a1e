"""Model cards: of the champion as typed, of skills and orchestrators, and that papers are those of the bibliography."""

import re
from pathlib import Path

import numpy as np
import pytest
import yaml

from service.registry.bundled import BUNDLED
from service.registry.card import PAPERS, model_card
from service.registry.registry import Registry
from tests.cli.typed import assert_refused, tandem
from tests.registry.helpers import Publish

BIBLIOGRAPHY = Path(__file__).parents[2] / "docs" / "bibliography.md"


def parts(card: str) -> tuple[dict, str]:
    """The head and the rest."""
    _, head, body = card.split("---\n", 2)
    return yaml.safe_load(head), body


def test_the_champions_card_says_what_its_manifest_says(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run = tandem("registry", "card", "panda-cube@champion", "--out", "README.md")
    manifest = Registry(BUNDLED).manifest("panda-cube@champion")
    assert run.stdout == f"the card of {manifest.reference} is in README.md\n"
    head, body = parts(Path("README.md").read_text())
    assert (head["license"], head["library_name"], head["pipeline_tag"]) == ("apache-2.0", "tandem-skills", "robotics")
    assert {"robotics", "primitives", "arxiv:2410.04855"} <= set(head["tags"])
    (index,) = head["model-index"]
    found = {result["dataset"]["name"]: result["metrics"][0]["value"] for result in index["results"]}
    rates = {kind: manifest.metrics[f"evaluation/{kind}_success_last"] for kind in ("table", "air", "mixed")}
    assert found == pytest.approx(rates, abs=1e-4)
    assert f"| mixed | {rates['mixed']:.1%} | {manifest.metrics['evaluation/mixed_success_ever']:.1%} |" in body
    assert f"| env steps | {manifest.metrics['env_steps']:,.0f} |" in body
    assert "| parameters | 74," in body
    assert "```sh\npip install .\n```" in body  # no index has Tandem
    config = re.search(r"The whole configuration:\n\n```yaml\n(.*?)```", body, re.DOTALL)
    assert yaml.safe_load(config[1]) == manifest.config
    code = re.search(r"```python\n(.*?)```", body, re.DOTALL)
    scope = {"observation": np.zeros((2, 14), dtype=np.float32)}
    exec(code[1], scope)
    assert scope["action"].shape == (2, 4)


def test_skills_and_orchestrators_have_cards_of_their_own(registry: Registry, publish: Publish):
    lsd = {"kind": "skills", "skill": 2, "action": 4}
    skills = publish("skills", spaces=lsd, config={"skills": {"method": "lsd"}}, metrics={"coverage": 0.25})
    spaces = {"kind": "orchestrator", "task": "push", "method": "ours-her", "primitives": "panda-cube@6"}
    numbers = {
        "evaluation/success_last": 0.9,
        "evaluation/success_last_low": 0.85,
        "evaluation/success_last_high": 0.93,
    }
    first = publish("pushes", spaces=spaces)
    pushes = publish("pushes", spaces=spaces, config={"seed": 5}, metrics=numbers, parent=first)
    head, body = parts(model_card(registry.manifest(str(skills))))
    assert "skills" in head["tags"]
    assert "model-index" not in head
    for said in ("found by LSD", "| robot | panda |", "| `coverage` | 0.25 |", 'load("skills@1"', PAPERS["lsd"][1]):
        assert said in body
    head, body = parts(model_card(registry.manifest(str(pushes)), licence="mit"))
    assert head["license"] == "mit"
    assert head["model-index"][0]["results"][0]["dataset"]["name"] == "of the task push"
    for said in (
        "acts with the frozen primitives `panda-cube@6`",
        "| of the task push | 90.0% | - |",
        "| `evaluation/success_last_low` | 0.85 |",
        "| seed | 5 |",
        "| trained on from | `pushes@1` |",
        'load("pushes@2"',
        PAPERS["her"][1],
    ):
        assert said in body, said
    assert body.endswith("## Licence\n\nmit\n")
    own = publish("own", spaces=spaces | {"task": "mine.py", "own_task": {"title": "Mine"}}, metrics=numbers)
    bodies = body, parts(model_card(registry.manifest(str(own))))[1]
    for said in ("succeeded as the task says", "read its task's code above, and add `run_task_code=True`"):
        assert [said in each for each in bodies] == [False, True], said


def test_a_card_says_how_primitives_were_learned():
    manifests = Registry(BUNDLED)
    for name, said in (
        ("panda-cube", "learned by self-play"),
        ("panda-cube-robust", "learned from other ones"),
        ("panda-two-cubes", "learned by self-play"),
    ):
        body = model_card(manifests.manifest(f"{name}@latest"))
        assert [each for each in ("learned by self-play,", "learned from other ones,") if each in body] == [f"{said},"]


def test_without_a_file_it_is_printed_and_what_is_not_there_is_refused(tmp_path, registry: Registry, publish: Publish):
    publish()
    run = tandem("registry", "card", "panda-cube@1", "--registry", registry.root)
    assert run.stdout == model_card(registry.manifest("panda-cube@1"))
    for arguments, said in (
        (["panda-cube@77"], "77"),
        (["panda-cube@1", "--out", str(tmp_path)], "cannot write"),
    ):
        assert_refused(tandem("registry", "card", *arguments, "--registry", registry.root), said)


def test_papers_are_those_of_the_bibliography():
    text = BIBLIOGRAPHY.read_text()
    for number, words in PAPERS.values():
        line = next(line for line in text.replace("\n  ", " ").splitlines() if number in line)
        authors, title, year = re.fullmatch(r"(.*): \*(.*)\*, (\d{4})", words).groups()
        assert authors in line
        assert title in line
        assert year in line
