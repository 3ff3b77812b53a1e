"""What worlds draw where their configuration gives ranges: a compiled model of a bank, and noise of what is seen.

Compiling a model takes milliseconds and stepping another one costs nothing, so worlds draw one of the bank at each
start instead of changing one of their own (domain randomisation of dynamics, Peng et al. 2018). Noise is a function of
a key and a count, so that a world's state says all of it.
"""

from __future__ import annotations

import mujoco
import numpy as np

from service.base.types import Array, StateArray
from service.config import WorldConfig
from service.config.objects import ObstacleConfig
from service.envs.robot import described
from service.envs.scene import FIXTURE_PREFIX, build_model

_SEED = 0
KEYS = 1 << 52
"""Keys are whole numbers below this, which a float64 holds exactly."""
_GOLDEN, _FIRST, _SECOND = (np.uint64(each) for each in (0x9E3779B97F4A7C15, 0xBF58476D1CE4E5B9, 0x94D049BB133111EB))


class ModelBank:
    """The models of a world, one where it gives no ranges.

    Args:
        config: the world.
    """

    def __init__(self, config: WorldConfig) -> None:
        ranges = config.randomisation.model_ranges
        self.largest = _variant(config, {name: high for name, (_, high) in ranges.items() if name == "object_size"})
        """The world with the largest object: where that has room to start, each has."""
        self.nominal: mujoco.MjModel = build_model(config)
        """Without any of it."""
        self.drawn = _spread(ranges, config.randomisation.num_models) if ranges else {}
        """(M,) values by the names of ``RandomisationConfig``."""
        num = config.randomisation.num_models if ranges else 1
        rows = [{name: float(values[index]) for name, values in self.drawn.items()} for index in range(num)]
        variants = [_variant(config, row) for row in rows]
        self.models = [
            self.nominal if not row else _compile(variant, row) for variant, row in zip(variants, rows, strict=True)
        ]
        """M of them."""
        self.table_height_m: StateArray = self.drawn.get("table_height_m", np.zeros(num))
        """(M,) above where the configuration has it."""
        self.rest_heights_m: StateArray = self.table_height_m[:, None] + [each.rest_heights_m for each in variants]
        """(M, K) height of each object's centre as it lies on the table."""

    def __len__(self) -> int:
        return len(self.models)

    def of(self, index: Array) -> list[mujoco.MjModel] | mujoco.MjModel:
        """Models of worlds by their (N,) indices, as MuJoCo's rollout takes them."""
        return self.models[0] if len(self.models) == 1 else [self.models[each] for each in index.astype(np.intp)]


def _spread(ranges: dict[str, tuple[float, float]], num: int) -> dict[str, StateArray]:
    """Draw ``num`` values of each range, together evenly spread (Latin hypercube, McKay et al. 1979)."""
    rng = np.random.default_rng(_SEED)
    shares = {name: (rng.permutation(num) + rng.random(num)) / num for name in ranges}
    return {name: low + (high - low) * shares[name] for name, (low, high) in ranges.items()}


def _variant(config: WorldConfig, drawn: dict[str, float]) -> WorldConfig:
    """The world with an object as drawn."""
    same = {"object_mass_kg": "mass_kg", "friction": "friction"}
    changed: dict[str, object] = {name: drawn[name] for name in same if name in drawn}
    alike, factor = {same[name]: value for name, value in changed.items()}, drawn.get("object_size", 1.0)
    given = config.objects or (config.object,)
    bodies = tuple(
        _scaled(body, factor).model_copy(
            update={key: value for key, value in alike.items() if getattr(each, key, None) is None}
        )
        for each, body in zip(given, config.bodies, strict=True)  # a description keeps its own mass and friction
    )
    if config.objects:
        changed["objects"] = bodies
    elif "object_size" in drawn:
        changed["object"] = bodies[0]
    return config.model_copy(update=changed)


def _scaled(body: ObstacleConfig, factor: float) -> ObstacleConfig:
    """An object of so many times the size."""
    size, mesh = tuple(factor * each for each in body.size_m), body.mesh
    if mesh is not None:
        center = tuple(factor * each for each in mesh.center_m)
        of_size = {"scale": mesh.scale * factor, "center_m": center, "volume_m3": mesh.volume_m3 * factor**3}
        mesh = mesh.model_copy(update=of_size)
    return body.model_copy(update={"size_m": size, "mesh": mesh})


def _compile(config: WorldConfig, drawn: dict[str, float]) -> mujoco.MjModel:
    model = build_model(config)
    servos = slice(0, len(described(config).joints))  # those of the arm come first
    gain, damping = drawn.get("gain", 1.0), drawn.get("damping", 1.0)
    model.actuator_gainprm[servos, 0] *= gain
    model.actuator_biasprm[servos, 1] *= gain
    model.actuator_biasprm[servos, 2] *= damping
    height_m = drawn.get("table_height_m", 0.0)
    for geom in range(model.ngeom):
        name = model.geom(geom).name
        if name != "table" and not name.startswith(FIXTURE_PREFIX):
            continue
        body = int(model.geom_bodyid[geom])
        if body == 0:
            model.geom_pos[geom, 2] += height_m
        elif model.body_mocapid[body] < 0 and geom == model.body_geomadr[body]:  # once for a body of several geoms
            model.body_pos[body, 2] += height_m
    # The world's own geoms have all moved, and so must the tree of bounds that MuJoCo finds them by: else what has
    # several geoms, as a finger has, is sought at the old height, and sinks into a raised table.
    first, num = model.body_bvhadr[0], model.body_bvhnum[0]
    model.bvh_aabb[first : first + num, 2] += height_m
    return model


def normal(key: StateArray, count: StateArray, size: int) -> StateArray:
    """(N, size) independent standard normal numbers for (N,) keys and counts; equal ones give equal numbers."""
    draws = np.arange(2 * size, dtype=np.uint64)
    state = (_mixed(key.astype(np.uint64)) + count.astype(np.uint64))[:, None] * np.uint64(2 * size) + draws
    uniform = (_mixed(state) >> np.uint64(11)).astype(np.float64) * 2.0**-53
    radius = np.sqrt(-2.0 * np.log1p(-uniform[:, :size]))
    made: StateArray = radius * np.cos(2.0 * np.pi * uniform[:, size:])  # Box and Muller 1958
    return made


def _mixed(values: np.ndarray) -> np.ndarray:
    """SplitMix64 (Steele et al. 2014)."""
    mixed = values * _GOLDEN + _GOLDEN
    mixed = (mixed ^ (mixed >> np.uint64(30))) * _FIRST
    mixed = (mixed ^ (mixed >> np.uint64(27))) * _SECOND
    return mixed ^ (mixed >> np.uint64(31))
