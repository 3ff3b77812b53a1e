"""How far the object goes in the representation of skills, phi, by a step sideways and by one upward.

    python -m benchmarks.steps_in_phi --registry docs/results/v2/primitives --json docs/results/steps_in_phi.json

LSD, METRA and CSF pay the way in phi along a skill, so this says what they pay for at most: all versions of them in a
registry, at random places of the object on the table, and above it.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.measuring import machine, one_line_errors, write_json
from service.base.types import FloatArray, StateArray
from service.config.skills import SkillDiscoveryConfig
from service.config.world import WorkspaceConfig
from service.policies.forward import relu_layers
from service.policies.frozen_skills import FrozenSkills, normalised_place
from service.registry.loading import load
from service.registry.registry import Registry

STEP_M = 0.02
"""About as far as a push moves the object in an env step."""
HEIGHTS_M = (0.025, 0.1, 0.2)
"""Of the object's centre: on the table, and in the air."""


def steps_in_phi(skills: FrozenSkills, workspace: WorkspaceConfig, num: int = 2_000) -> dict[str, Any]:
    """Mean lengths in phi from ``num`` places of the object: of steps of 2 cm, and from the table to the box's top."""
    rng = np.random.default_rng(0)
    places = rng.uniform(workspace.lower_m, workspace.upper_m, (num, 3))

    def at(height_m: float) -> StateArray:
        return np.column_stack((places[:, :2], np.full(num, height_m)))

    def phi(place: StateArray) -> FloatArray:
        found: FloatArray = relu_layers(np, skills.network, normalised_place(place.astype(np.float32)))
        return found

    def mean_way(begin: StateArray, end: StateArray) -> float:
        return float(np.linalg.norm(phi(end) - phi(begin), axis=1).mean())

    table = at(HEIGHTS_M[0])
    sideways = [mean_way(table, table + step) for step in ((STEP_M, 0.0, 0.0), (0.0, STEP_M, 0.0))]
    return {
        "sideways": float(np.mean(sideways)),
        "upward": [mean_way(at(height), at(height + STEP_M)) for height in HEIGHTS_M],
        "table_to_top": mean_way(table, at(workspace.upper_m[2])),
    }


@one_line_errors
def main() -> int:
    """Entry point of ``python -m benchmarks.steps_in_phi``."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--registry", type=Path, required=True)
    parser.add_argument("--json", type=Path, required=True)
    given = parser.parse_args()
    found = []
    for name in Registry(given.registry).names():
        trained = load(f"{name}@latest", given.registry)
        if isinstance(config := trained.config, SkillDiscoveryConfig) and config.skills.zero_shot == "way":
            measured = steps_in_phi(trained.skills, config.world.workspace)
            found.append({"method": config.skills.method, "name": name, **measured})
    result = {"benchmark": "steps_in_phi", "machine": machine(), "step_m": STEP_M, "heights_m": HEIGHTS_M}
    write_json(given.json, {**result, "skills": found})
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
