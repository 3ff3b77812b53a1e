"""Model cards: what a version says about itself, in Markdown with the YAML head that hubs of models read."""

from __future__ import annotations

import re
from collections.abc import Mapping
from math import prod
from typing import Any

import yaml

from service.base.markdown import table
from service.config.skills import SKILLS_OF
from service.config.task_methods import TASK_METHODS
from service.registry.manifest import Manifest

LICENCE = "apache-2.0"
"""Tandem's own, as hubs write it."""
PAPERS = {
    "tandem": (
        "2410.04855",
        "Paul Jansonnie, Bingbing Wu, Julien Perez, Jan Peters: *Unsupervised Skill Discovery for Robotic "
        "Manipulation through Automatic Task Generation*, 2024",
    ),
    "self-play": (
        "2101.04882",
        "OpenAI and others: *Asymmetric self-play for automatic goal discovery in robotic manipulation*, 2021",
    ),
    "mcp": (
        "1905.09808",
        "Xue Bin Peng, Michael Chang, Grace Zhang, Pieter Abbeel, Sergey Levine: *MCP: Learning Composable "
        "Hierarchical Control with Multiplicative Compositional Policies*, 2019",
    ),
    "ppo": ("1707.06347", "John Schulman and others: *Proximal Policy Optimization Algorithms*, 2017"),
    "sac": ("1812.05905", "Tuomas Haarnoja and others: *Soft Actor-Critic Algorithms and Applications*, 2018"),
    "her": ("1707.01495", "Marcin Andrychowicz and others: *Hindsight Experience Replay*, 2017"),
    "diayn": (
        "1802.06070",
        "Benjamin Eysenbach and others: *Diversity is All You Need: Learning Skills without a Reward Function*, 2018",
    ),
    "dads": ("1907.01657", "Archit Sharma and others: *Dynamics-Aware Unsupervised Discovery of Skills*, 2019"),
    "lsd": ("2202.00914", "Seohong Park and others: *Lipschitz-constrained Unsupervised Skill Discovery*, 2022"),
    "metra": (
        "2310.08887",
        "Seohong Park, Oleh Rybkin, Sergey Levine: *METRA: Scalable Unsupervised RL with Metric-Aware Abstraction*, "
        "2023",
    ),
    "csf": (
        "2412.08021",
        "Chongyi Zheng, Jens Tuyls, Joanne Peng, Benjamin Eysenbach: *Can a MISL Fly? Analysis and Ingredients for "
        "Mutual Information Skill Learning*, 2024",
    ),
}
"""Numbers at arXiv and citations, as in ``docs/bibliography.md``, which does not come with the package."""
_RATE = re.compile(r"evaluation/(?:(\w+)_)?success_(last|ever)")
_HISTORY = "Settings that changed on the way, and records that were lost:"
_SUCCESS = "Share of episodes in which every object was at its goal, in simulation and without noise in the actions:"
_OWN = "Share of episodes that succeeded as the task says, in simulation and without noise in the actions:"
_WHEN = {"last": "success at the last step", "ever": "success at any step"}


def model_card(manifest: Manifest, *, licence: str = LICENCE) -> str:
    """The card of a version of any kind.

    Args:
        manifest: of the version.
        licence: of its parameters, as hubs write it.
    """
    spaces, config, metrics = manifest.spaces, manifest.config, manifest.metrics
    what, code, after, papers = _kind(manifest)
    rates = _rates(manifest)
    tags = ("robotics", "reinforcement-learning", "mujoco", str(spaces.get("kind", "primitives")))
    head = {
        "license": licence,
        "library_name": "tandem-skills",
        "pipeline_tag": "robotics",
        "tags": [*tags, *(f"arxiv:{PAPERS[key][0]}" for key in papers)],
        **({"model-index": [{"name": manifest.name, "results": _model_index(rates)}]} if rates else {}),
    }
    things, robot = _at(config, "world", "objects") or [_at(config, "world", "object")], _at(config, "world", "robot")
    facts = {
        "robot": _at(robot, "name") or robot or "panda",
        "objects" if len(things) > 1 else "object": ", ".join(
            str(_at(thing, "shape") if isinstance(thing, Mapping) else thing) for thing in things
        ),
        "simulator": "MuJoCo",
        **{name: f"{spaces[name]} numbers" for name in ("observation", "action") if isinstance(spaces.get(name), int)},
        "parameters": f"{sum(prod(each.shape) for each in manifest.tensors.values()):,}",
        "sha256 of the parameters": f"`{manifest.blob_sha256}`",
    }
    training = {
        "env steps": f"{metrics['env_steps']:,.0f}" if "env_steps" in metrics else None,
        "method": spaces.get("method") or _at(config, "skills", "method"),
        "seed": config.get("seed"),
        "trained on from": f"`{manifest.parent}`" if manifest.parent else None,
        "published": manifest.created,
        "code": f"commit `{manifest.git_commit}`" if manifest.git_commit else None,
    }
    success = [
        (where, *(f"{found[when]:.1%}" if when in found else "-" for when in _WHEN)) for where, found in rates.items()
    ]
    others = [
        (f"`{name}`", f"{value:.6g}")
        for name, value in metrics.items()
        if name != "env_steps" and not _RATE.fullmatch(name)
    ]
    parts = [
        f"---\n{yaml.safe_dump(head, sort_keys=False, allow_unicode=True)}---",
        f"# {manifest.reference}",
        what,
        table(("", ""), facts.items()),
        "## How it was trained",
        table(("", ""), ((name, value) for name, value in training.items() if value is not None)),
        *([_HISTORY, _yaml(manifest.history)] if manifest.history else []),
        "The whole configuration:",
        _yaml(config),
        "## Results",
        *([_OWN if "own_task" in spaces else _SUCCESS, table(("goals", *_WHEN.values()), success)] if success else []),
        *([table(("metric", "value"), others)] if others else []),
        *(["The version has none."] if not success and not others else []),
        "## How to load it",
        "No index of packages has Tandem yet. In a clone of its repository:",
        "```sh\npip install .\n```",
        f"```python\nimport tandem_skills as tandem\n\n{code}\n```",
        f"`registry` is a directory, or the `http://HOST:PORT` of a `tandem serve`. {after}",
        "## Papers",
        "\n".join(f"- {words}. [arXiv {number}](https://arxiv.org/abs/{number})."
                  for number, words in (PAPERS[key] for key in papers)),
        "## Licence",
        licence,
    ]  # fmt: skip
    return "\n\n".join(parts) + "\n"


def _kind(manifest: Manifest) -> tuple[str, str, str, list[str]]:
    """What differs by kind: what it is, code that loads it, words about that, and keys of the papers it rests on."""
    spaces, config, name = manifest.spaces, manifest.config, manifest.reference
    after = "In place of the name, the folder that `tandem registry export` has written will do."
    if spaces.get("kind") == "orchestrator":
        method, frozen = str(spaces.get("method", "")), spaces.get("primitives", "?")
        skilled = method in TASK_METHODS and TASK_METHODS[method].takes == "skills"
        takes, how = ("skills", [method] * (method in PAPERS)) if skilled else ("primitives", ["self-play", "mcp"])
        return (
            f"An orchestrator of Tandem: a policy for the task *{spaces.get('task', '?')}* that acts with the frozen "
            f"{takes} `{frozen}` (digest `{str(spaces.get('primitives_digest', '?'))[:12]}`), and with no others.",
            f'policy = tandem.load("{name}", registry="registry")\n'
            "policy.begin()  # before new episodes: it remembers the step before\n"
            "action = policy.act_deterministic(observation)  # (N, O) positions and goal -> (N, 4)",
            f"The registry, or the one that comes with the package, has to have `{frozen}`, too."
            + " To evaluate it, read its task's code above, and add `run_task_code=True`." * ("own_task" in spaces),
            ["tandem", *how, "sac", *["her"] * method.endswith("-her")],
        )
    if spaces.get("kind") == "skills":
        method = str(_at(config, "skills", "method") or "?")
        found_by = method.upper() if method in SKILLS_OF else method
        return (
            f"Frozen skills of Tandem, found by {found_by}: a policy that acts by a vector of "
            f"{spaces.get('skill')} numbers. No task and no reward was written for them.",
            f'skills = tandem.load("{name}", registry="registry").skills',
            after,
            [*[method] * (method in PAPERS), "sac", "tandem"],
        )
    learned = "by self-play, in which Alice proposes goals and Bob reaches them"
    if _at(config, "distillation") is not None:
        learned = "from other ones, which saw more and had been learned by self-play (distillation)"
    return (
        f"{_at(config, 'policy', 'bob', 'num_primitives') or 'The'} frozen primitives of Tandem, and the gate that "
        f"composes them: a policy that brings objects to goals. They were learned {learned}. No task and no reward "
        "was written for them. New tasks are learned by composing them.",
        f'bob = tandem.load("{name}", registry="registry")\n'
        "action = bob.policy.act_deterministic(observation)  "
        f"# (N, {spaces.get('observation', 'O')}) positions and goal -> (N, 4)",
        after,
        ["tandem", "self-play", "mcp", "ppo"],
    )


def _rates(manifest: Manifest) -> dict[str, dict[str, float]]:
    """Success rates by words for where goals are, and by when success is asked for."""
    rates: dict[str, dict[str, float]] = {}
    for name, value in manifest.metrics.items():
        if (match := _RATE.fullmatch(name)) is not None:
            where = match[1] or f"of the task {manifest.spaces.get('task', '')}".rstrip()
            if where.startswith("nominal_"):
                where = f"{where.removeprefix('nominal_')}, in the world as it is in the middle of its ranges"
            rates.setdefault(where, {})[match[2]] = value
    return rates


def _model_index(rates: Mapping[str, Mapping[str, float]]) -> list[dict[str, Any]]:
    return [
        {
            "task": {"type": "robotics", "name": "Tabletop manipulation"},
            "dataset": {"type": "tandem", "name": where},
            "metrics": [
                {"type": "success_rate", "name": name, "value": round(found[when], 4)}
                for when, name in _WHEN.items()
                if when in found
            ],
        }
        for where, found in rates.items()
    ]


def _at(tree: Any, *keys: str) -> Any:
    """What a tree of plain values has there; None where it has nothing."""
    for key in keys:
        tree = tree.get(key) if isinstance(tree, Mapping) else None
    return tree


def _yaml(tree: Any) -> str:
    return f"```yaml\n{yaml.safe_dump(tree, sort_keys=False).rstrip()}\n```"
