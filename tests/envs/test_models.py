"""The worlds that the published policies act in: what MuJoCo compiles of them stays as it is.

Where a change is meant, say in the changelog that what was trained before acts in another world, and record the numbers
anew: ``python -m tests.envs.test_models``.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from benchmarks.measuring import write_json
from service.config import load_config
from service.envs.scene import build_model

FILE = Path(__file__).parent / "data/models.json"
RECIPE = Path(__file__).parents[2] / "configs/pretrain/panda_cube.yaml"
FIELDS = (
    "actuator_biasprm", "actuator_forcerange", "actuator_gainprm", "body_inertia", "body_ipos", "body_iquat",
    "body_mass", "body_pos", "body_quat", "dof_armature", "dof_damping", "dof_frictionloss", "eq_data",
    "eq_solref", "geom_conaffinity", "geom_condim", "geom_contype", "geom_friction", "geom_margin",
    "geom_pos", "geom_quat", "geom_size", "geom_solimp", "geom_solref", "geom_type", "jnt_axis", "jnt_pos",
    "jnt_range", "jnt_solimp", "jnt_solref", "qpos0", "site_pos",
)  # fmt: skip
OPTIONS = (
    "cone", "gravity", "impratio", "integrator", "iterations", "noslip_iterations", "solver", "timestep",
    "tolerance",
)  # fmt: skip
WORLDS = {
    "recipe": (),
    "wall": ("world.fixture=wall",),
    "sphere in a box": ("world.fixture=box", "world.object=sphere"),
}


def compiled(name: str) -> dict[str, list[float]]:
    model = build_model(load_config(RECIPE, WORLDS[name]).world)
    numbers = {each: getattr(model, each) for each in FIELDS} | {each: getattr(model.opt, each) for each in OPTIONS}
    return {each: np.asarray(value, dtype=np.float64).ravel().round(10).tolist() for each, value in numbers.items()}


@pytest.mark.parametrize("name", WORLDS)
def test_it_is_the_world_that_was_trained_in(name: str) -> None:
    worlds = json.loads(FILE.read_text(encoding="utf-8"))
    recorded = worlds["recipe"] | worlds[name]
    for what, numbers in compiled(name).items():
        np.testing.assert_allclose(numbers, recorded[what], rtol=1e-7, atol=1e-9, err_msg=what)


def main() -> None:
    """Record all numbers of the recipe's world, and of the others those that differ from it."""
    worlds = {name: compiled(name) for name in WORLDS}
    recipe = worlds["recipe"]
    for name in [*worlds][1:]:
        worlds[name] = {what: numbers for what, numbers in worlds[name].items() if numbers != recipe[what]}
    write_json(FILE, worlds)


if __name__ == "__main__":
    main()
