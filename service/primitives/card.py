"""Model cards: what a version says about itself, in Markdown with the YAML head that hubs of models read."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import yaml

from service.primitives.loading import ORCHESTRATOR, SKILLS
from service.registry.manifest import Manifest

LICENCE = "apache-2.0"
"""Tandem's own, as hubs write it."""
_PRIMITIVES = "primitives"
_LEARNED = {
    False: "They were learned by self-play, in which Alice proposes goals and Bob reaches them.",
    True: "They were learned from other ones, which saw more and had been learned by self-play (distillation).",
}
_SUCCESS = re.compile(r"evaluation/(?:(\w+)_)?success_(last|ever)")


class Paper(NamedTuple):
    """A paper as ``docs/bibliography.md`` has it, which does not come with the package."""

    authors: str
    title: str
    year: int
    arxiv: str


PAPERS = {
    "tandem": Paper(
        "Paul Jansonnie, Bingbing Wu, Julien Perez, Jan Peters",
        "Unsupervised Skill Discovery for Robotic Manipulation through Automatic Task Generation",
        2024,
        "2410.04855",
    ),
    "self-play": Paper(
        "OpenAI and others",
        "Asymmetric self-play for automatic goal discovery in robotic manipulation",
        2021,
        "2101.04882",
    ),
    "mcp": Paper(
        "Xue Bin Peng, Michael Chang, Grace Zhang, Pieter Abbeel, Sergey Levine",
        "MCP: Learning Composable Hierarchical Control with Multiplicative Compositional Policies",
        2019,
        "1905.09808",
    ),
    "ppo": Paper("John Schulman and others", "Proximal Policy Optimization Algorithms", 2017, "1707.06347"),
    "sac": Paper("Tuomas Haarnoja and others", "Soft Actor-Critic Algorithms and Applications", 2018, "1812.05905"),
    "her": Paper("Marcin Andrychowicz and others", "Hindsight Experience Replay", 2017, "1707.01495"),
    "diayn": Paper(
        "Benjamin Eysenbach and others",
        "Diversity is All You Need: Learning Skills without a Reward Function",
        2018,
        "1802.06070",
    ),
    "dads": Paper(
        "Archit Sharma and others", "Dynamics-Aware Unsupervised Discovery of Skills", 2019, "1907.01657"
    ),
    "lsd": Paper(
        "Seohong Park and others", "Lipschitz-constrained Unsupervised Skill Discovery", 2022, "2202.00914"
    ),
    "metra": Paper(
        "Seohong Park, Oleh Rybkin, Sergey Levine",
        "METRA: Scalable Unsupervised RL with Metric-Aware Abstraction",
        2023,
        "2310.08887",
    ),
}  # fmt: skip


def model_card(manifest: Manifest, *, licence: str = LICENCE) -> str:
    """The card of a version of any kind.

    Args:
        manifest: of the version.
        licence: of its parameters, as hubs write it.
    """
    sections = (_what, _how_trained, _results, _how_to_load, _papers)
    body = "\n\n".join(text for section in sections for text in section(manifest))
    head = yaml.safe_dump(_head(manifest, licence), sort_keys=False, allow_unicode=True)
    return f"---\n{head}---\n\n{body}\n\n## Licence\n\n{licence}\n"


def _head(manifest: Manifest, licence: str) -> dict[str, Any]:
    """The YAML head; results are in the form of a hub's ``model-index``."""
    kind = _kind(manifest)
    papers = [f"arxiv:{PAPERS[key].arxiv}" for key in _paper_keys(manifest)]
    results = [
        {
            "task": {"type": "robotics", "name": "Tabletop manipulation"},
            "dataset": {"type": "tandem", "name": _goals(manifest, where)},
            "metrics": [
                {"type": "success_rate", "name": name, "value": round(rates[when], 4)}
                for when, name in _WHEN.items()
                if when in rates
            ],
        }
        for where, rates in _rates(manifest).items()
    ]
    return {
        "license": licence,
        "library_name": "tandem-skills",
        "pipeline_tag": "robotics",
        "tags": ["robotics", "reinforcement-learning", "mujoco", kind, *papers],
        **({"model-index": [{"name": manifest.name, "results": results}]} if results else {}),
    }


def _what(manifest: Manifest) -> Iterator[str]:
    yield f"# {manifest.reference}"
    spaces, kind = manifest.spaces, _kind(manifest)
    config = manifest.config
    if kind == ORCHESTRATOR:
        yield (
            f"An orchestrator of Tandem: a policy for the task *{spaces.get('task', '?')}* that acts with the frozen "
            f"{_takes(manifest)} `{spaces.get('primitives', '?')}` (digest "
            f"`{str(spaces.get('primitives_digest', '?'))[:12]}`), and with no others."
        )
    elif kind == SKILLS:
        yield (
            f"Frozen skills of Tandem, found by {str(_at(config, 'skills', 'method') or '?').upper()}: a policy that "
            f"acts by a vector of {_text(spaces.get('skill'))} numbers. No task and no reward was written for them."
        )
    else:
        num = _first(_at(config, "policy", "bob", "num_primitives"), "The")
        yield (
            f"{num} frozen primitives of Tandem, and the gate that composes them: a policy that brings an object to a "
            f"goal. {_LEARNED[_at(config, 'distillation') is not None]} No task and no reward was written for them. "
            "New tasks are learned by composing them."
        )
    thing = _at(config, "world", "object")
    rows = [
        ("robot", _at(config, "world", "robot", "name") or _at(config, "world", "robot") or "panda"),
        ("object", thing if not isinstance(thing, Mapping) else thing.get("shape")),
        ("simulator", "MuJoCo"),
        ("observation", _numbers(spaces.get("observation"))),
        ("action", _numbers(spaces.get("action"))),
        ("parameters", f"{sum(_product(each.shape) for each in manifest.tensors.values()):,}"),
        ("sha256 of the parameters", f"`{manifest.blob_sha256}`"),
    ]
    yield _table(("", ""), [(name, _text(value)) for name, value in rows if value is not None])


def _how_trained(manifest: Manifest) -> Iterator[str]:
    yield "## How it was trained"
    steps = manifest.metrics.get("env_steps")
    method = manifest.spaces.get("method") or _at(manifest.config, "skills", "method")
    rows = [
        ("env steps", f"{steps:,.0f}" if steps is not None else None),
        ("method", method),
        ("seed", _first(_at(manifest.config, "seed"), _at(manifest.config, "trial", "seed"))),
        ("trained on from", f"`{manifest.parent}`" if manifest.parent else None),
        ("published", manifest.created),
        ("code", f"commit `{manifest.git_commit}`" if manifest.git_commit else None),
    ]
    yield _table(("", ""), [(name, _text(value)) for name, value in rows if value is not None])
    if manifest.history:
        yield "Settings that changed on the way, and records that were lost:"
        yield _fenced("yaml", yaml.safe_dump(manifest.history, sort_keys=False))
    yield "The whole configuration:"
    yield _fenced("yaml", yaml.safe_dump(manifest.config, sort_keys=False))


def _results(manifest: Manifest) -> Iterator[str]:
    yield "## Results"
    rates = _rates(manifest)
    if rates:
        yield "Share of episodes in which the object was at its goal, in simulation and without noise in the actions:"
        cells = []
        for where, found in rates.items():
            low, high = (manifest.metrics.get(f"evaluation/success_last_{end}") for end in ("low", "high"))
            interval = f"{low:.1%} to {high:.1%}" if low is not None and high is not None and not where else "-"
            shown = [f"{found[when]:.1%}" if when in found else "-" for when in _WHEN]
            cells.append((_goals(manifest, where), *shown, interval))
        header = ("goals", *_WHEN.values(), "95 % interval of the first")
        if all(row[-1] == "-" for row in cells):
            header, cells = header[:-1], [row[:-1] for row in cells]
        yield _table(header, cells)
    counted = {*(name for name in manifest.metrics if name.startswith("evaluation/success_")), "env_steps"}
    others = [
        (f"`{name}`", f"{value:.6g}")
        for name, value in manifest.metrics.items()
        if name not in counted and not _SUCCESS.fullmatch(name)
    ]
    if others:
        yield _table(("metric", "value"), others)
    if not rates and not others:
        yield "The version has none."


def _how_to_load(manifest: Manifest) -> Iterator[str]:
    kind, name = _kind(manifest), manifest.reference
    size = manifest.spaces.get("observation", "O")
    yield "## How to load it"
    yield "No index of packages has Tandem yet. In a clone of its repository:"
    yield _fenced("sh", "pip install .")
    if kind == ORCHESTRATOR:
        code = [
            f'policy = service.load_policy("{name}", registry="registry")',
            "policy.begin()  # before new episodes: it remembers the step before",
            "action = policy.act_deterministic(observation)  # (N, O) positions and goal -> (N, 4)",
        ]
        needed = manifest.spaces.get("primitives")
        after = f"The registry, or the one that comes with the package, has to have `{needed}`, too."
    elif kind == SKILLS:
        code = [f'skills = service.load_skills("{name}", registry="registry").skills']
        after = _EXPORTED
    else:
        code = [
            f'bob = service.load_primitives("{name}", registry="registry")',
            f"action = bob.policy.act_deterministic(observation)  # (N, {size}) positions and goal -> (N, 4)",
        ]
        after = _EXPORTED
    yield _fenced("python", "\n".join(["import service", "", *code]))
    yield f"`registry` is a directory, or the `http://HOST:PORT` of a `tandem serve`. {after}"


def _papers(manifest: Manifest) -> Iterator[str]:
    yield "## Papers"
    lines = []
    for key in _paper_keys(manifest):
        paper = PAPERS[key]
        link = f"[arXiv {paper.arxiv}](https://arxiv.org/abs/{paper.arxiv})"
        lines.append(f"- {paper.authors}: *{paper.title}*, {paper.year}. {link}.")
    yield "\n".join(lines)


_EXPORTED = "In place of the name, the folder that `tandem registry export` has written will do."
_WHEN = {"last": "success at the last step", "ever": "success at any step"}


def _kind(manifest: Manifest) -> str:
    return str(manifest.spaces.get("kind", _PRIMITIVES))


def _takes(manifest: Manifest) -> str:
    return SKILLS if str(manifest.spaces.get("method", "")) in PAPERS else _PRIMITIVES


def _paper_keys(manifest: Manifest) -> list[str]:
    """Keys in ``PAPERS`` of what a version rests on."""
    kind, method = _kind(manifest), str(manifest.spaces.get("method", ""))
    if kind == SKILLS:
        found = str(_at(manifest.config, "skills", "method"))
        return [*([found] if found in PAPERS else []), "sac", "tandem"]
    if kind == ORCHESTRATOR:
        how = [method] if method in PAPERS else ["self-play", "mcp"]
        return ["tandem", *how, "sac", *(["her"] if method.endswith("-her") else [])]
    return ["tandem", "self-play", "mcp", "ppo"]


def _rates(manifest: Manifest) -> dict[str, dict[str, float]]:
    """Success rates by where goals are, empty for those of a task, and by when success is asked for."""
    rates: dict[str, dict[str, float]] = {}
    for name, value in manifest.metrics.items():
        if (match := _SUCCESS.fullmatch(name)) is not None:
            rates.setdefault(match[1] or "", {})[match[2]] = value
    return rates


def _goals(manifest: Manifest, where: str) -> str:
    """Words for where goals are, such as ``mixed`` or ``nominal_table``."""
    if not where:
        return f"of the task {manifest.spaces.get('task', '')}".rstrip()
    kind = where.removeprefix("nominal_")
    return where if kind == where else f"{kind}, in the world as it is in the middle of its ranges"


def _at(tree: Any, *keys: str) -> Any:
    """What a tree of plain values has there; None where it has nothing."""
    for key in keys:
        tree = tree.get(key) if isinstance(tree, Mapping) else None
    return tree


def _first(*values: Any) -> Any:
    return next((value for value in values if value is not None), None)


def _numbers(size: Any) -> str | None:
    return f"{size} numbers" if isinstance(size, int) else None


def _product(shape: tuple[int, ...]) -> int:
    product = 1
    for size in shape:
        product *= size
    return product


def _text(value: Any) -> str:
    return str(value).replace("|", "\\|").replace("\n", " ")


def _table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _fenced(language: str, text: str) -> str:
    return f"```{language}\n{text.rstrip()}\n```"
