"""Directions in which compositions of frozen primitives cannot push an object straight.

    python -m benchmarks.push_range panda-cube@champion runs/cube-1 --json docs/results/push_range.json

No simulator: the closed gripper stands behind the object, in random places, and of the means of many compositions some
push straight or none does. What none can do has to be planned round downstream, which is hard to learn (decision 8).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from benchmarks.measuring import of_each, run_benchmark
from service.methods.compose import check_primitives
from service.registry.learned import action_weights

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from service.registry.loading import Trained

DIRECTIONS = {"+x": (1.0, 0.0), "-x": (-1.0, 0.0), "+y": (0.0, 1.0), "-y": (0.0, -1.0)}
_RESTING_HEIGHT_M = 0.025
"""Height of the middle of a cube of 5 cm."""
_PLACES_M = 0.15
"""Farthest places from the origin, along x and along y."""
_BEHIND_M, _BESIDE_M, _HEIGHT_M = (0.055, 0.075), (-0.015, 0.015), (0.015, 0.035)
"""Place of the end effector, from the object's middle against and across the push; and its height."""
_LEAST = 0.1
"""Least displacement along the push, as a share of the greatest in a step."""
_ASIDE = 0.35
"""Greatest displacement across, as a share of that along the push; and up or down, as one of the greatest in a step."""
_ASIDE_OF = 0.3
"""Slow pushes may go aside as those of this speed."""


@dataclass(frozen=True, slots=True)
class Settings:
    """What is measured, and how much of it."""

    primitives: tuple[str, ...]
    """``NAME@ALIAS``, or run directories."""
    registry: str = "registry"
    num_places: int = 600
    """Places of the object, for each direction."""
    num_weights: int = 800
    """Weights from the whole range; a quarter more at its ends."""
    seed: int = 0


def positions_behind(rng: np.random.Generator, direction: tuple[float, float], num: int) -> NDArray[np.float32]:
    """(num, 11) positions: an object at random places on the table, the closed gripper behind it."""
    along = np.array([*direction, 0.0])
    across = np.array([-along[1], along[0], 0.0])
    places = np.column_stack([rng.uniform(-_PLACES_M, _PLACES_M, (num, 2)), np.full(num, _RESTING_HEIGHT_M)])
    effector = places - along * rng.uniform(*_BEHIND_M, (num, 1)) + across * rng.uniform(*_BESIDE_M, (num, 1))
    effector[:, 2] = rng.uniform(*_HEIGHT_M, num)
    return np.column_stack([effector, np.zeros((num, 2)), places, places - effector]).astype(np.float32)


def best_pushes(means: NDArray[np.float32], direction: tuple[float, float]) -> NDArray[np.float32]:
    """Greatest displacement along a direction of those (..., W, 4) means that go straight; where none does, -inf.

    Displacements are shares of the greatest in a step, as actions have them.
    """
    x, y = direction
    along, across = means[..., 0] * x + means[..., 1] * y, np.abs(means[..., 1] * x - means[..., 0] * y)
    straight = (across < _ASIDE * np.maximum(along, _ASIDE_OF)) & (np.abs(means[..., 2]) < _ASIDE)
    best: NDArray[np.float32] = np.where(straight, along, -np.inf).max(axis=-1)
    return best


def measure(trained: Trained, *, num_places: int, num_weights: int, seed: int) -> dict[str, float]:
    """Share of places in which no composition pushes straight, for each direction."""
    primitives, rng = check_primitives(trained), np.random.default_rng(seed)
    k = primitives.num_primitives
    drawn, corners = rng.uniform(-1.0, 1.0, (num_weights, k)), rng.choice([-1.0, 1.0], (num_weights // 4, k))
    weights = action_weights(np.concatenate([drawn, corners]).astype(np.float32))
    shares = {}
    for name, direction in DIRECTIONS.items():
        places = positions_behind(rng, direction, num_places)
        means, _ = primitives.compose(places[:, None], weights)
        shares[name] = float(np.mean(best_pushes(np.clip(means, -1.0, 1.0), direction) <= _LEAST))
    return shares


def benchmark(settings: Settings) -> dict[str, Any]:
    """Measure each of the primitives."""
    amount = {name: getattr(settings, name) for name in ("num_places", "num_weights", "seed")}
    rows = of_each(settings.primitives, settings.registry, lambda trained: {"impossible": measure(trained, **amount)})
    return {"rows": rows}


def report(result: dict[str, Any]) -> str:
    """A result for people."""
    return "\n".join(
        "  ".join([name, *(f"{direction} {share:.0%}" for direction, share in row["impossible"].items())])
        for name, row in result["rows"].items()
    )


if __name__ == "__main__":
    raise SystemExit(run_benchmark("push_range", __doc__, Settings, benchmark, report))
