"""In which directions can compositions of frozen primitives push an object straight?

    python benchmarks/push_range.py panda-cube@champion runs/cube-1 --out docs/results/push_range.json

No simulator: the closed gripper stands behind the object, in random places, and of the means of many compositions some
push straight or none does. What none can do has to be planned round downstream, which is hard to learn (decision 8).
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

sys.path.insert(0, str(Path(__file__).parents[1]))

import numpy as np

import service
from benchmarks.measuring import write_json
from service.downstream.compose import action_weights, check_primitives
from service.downstream.worker import find_provenance
from service.errors import TandemError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from service.primitives.loading import TrainedBob

DIRECTIONS = {"+x": (1.0, 0.0), "-x": (-1.0, 0.0), "+y": (0.0, 1.0), "-y": (0.0, -1.0)}
_RESTING_HEIGHT_M = 0.025
"""Of the middle of a cube of 5 cm."""
_PLACES_M = 0.15
"""How far from the origin places reach, along x and along y."""
_BEHIND_M, _BESIDE_M, _HEIGHT_M = (0.055, 0.075), (-0.015, 0.015), (0.015, 0.035)
"""Where the end effector stands, from the object's middle against and across the push; and its height."""
_LEAST = 0.1
"""Of the greatest displacement in a step, along the push."""
_ASIDE = 0.35
"""Greatest displacement across, as a share of that along the push; and up or down, as one of the greatest in a step."""
_ASIDE_OF = 0.3
"""Slow pushes may go aside as those of this speed."""


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


def measure(trained: TrainedBob, *, num_places: int, num_weights: int, seed: int) -> dict[str, float]:
    """Share of places in which no composition pushes straight, for each direction.

    Raises:
        TandemError: primitives that cannot be composed.
    """
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


def main() -> int:
    """Parse the command line, measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("primitives", nargs="+", metavar="NAME@ALIAS|RUN_DIR")
    parser.add_argument("--registry", default="registry")
    parser.add_argument("--places", type=int, default=600, help="of the object, for each direction")
    parser.add_argument("--weights", type=int, default=800, help="from the whole range; a quarter more at its ends")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, metavar="FILE")
    given = parser.parse_args()
    settings = {"num_places": given.places, "num_weights": given.weights, "seed": given.seed}
    try:
        rows: dict[str, Any] = {}
        for name in given.primitives:
            trained = service.load_primitives(name, given.registry)
            rows[name] = {**find_provenance(trained).primitives, "impossible": measure(trained, **settings)}
        if given.out is not None:
            write_json(given.out, {"settings": settings, "rows": rows})
    except TandemError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    for name, row in rows.items():
        print(name, *(f"{direction} {share:.0%}" for direction, share in row["impossible"].items()), sep="  ")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
