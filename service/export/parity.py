"""The parity test: what was written computes what the evaluator's policy does, or is not left behind.

Both compute in float32, in which the order of a sum matters. Where the policy has learned, that is a few millionths.
With inputs that are all at their clips its own rounding error is up to 2e-5, so there more is allowed.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from service.base.errors import ParityError
from service.base.types import FloatArray
from service.envs.observations import Layouts
from service.export.formats import Run
from service.export.networks import Network

TOLERANCE, EXTREME_TOLERANCE = 1e-5, 1e-4
"""Greatest absolute difference of an output: at recorded inputs and around them, and at extreme ones."""
_NUM_ROWS = 1000
"""Of each kind: recorded, around those, and extreme."""
_BEYOND_CLIP = 8.0
"""Extreme inputs are up to so many scales from their offsets; networks clip at 5."""
_FAR = 1e4

Rows = Mapping[str, FloatArray]
"""(N, size) rows by the networks' names of inputs."""


class Inputs(NamedTuple):
    """Inputs to compare at."""

    usual: Rows
    """Recorded ones, and random ones up to one scale around them, 12 cm for a place."""
    extreme: Rows
    """Random ones up to beyond where networks clip, some that are far out, and NaN in each number."""


class Differences(NamedTuple):
    """Greatest absolute differences of any output."""

    usual: float
    extreme: float


def make_inputs(observations: FloatArray, seen: Layouts) -> Inputs:
    """Make inputs of (T, E, O) observations that were recorded: T steps of E episodes."""
    rng = np.random.default_rng(0)
    size, offset, scale = seen.bob.size, seen.bob.normalisation.offset, seen.bob.normalisation.scale
    pairs = np.stack((observations[:-1], observations[1:])).reshape(2, -1, size)
    recorded = pairs[:, rng.permutation(pairs.shape[1])[:_NUM_ROWS]]
    around = recorded + scale * rng.uniform(-1.0, 1.0, recorded.shape)
    drawn = offset + _BEYOND_CLIP * scale * rng.uniform(-1.0, 1.0, (2, _NUM_ROWS, size))
    far = np.array([np.zeros(size), offset + _FAR, offset - _FAR])
    no_number = np.where(np.eye(size, dtype=bool), np.nan, offset)
    odd = np.concatenate((far, no_number))
    extreme = np.concatenate((drawn, np.stack((odd[::-1], odd))), axis=1)
    return Inputs(_rows(np.concatenate((recorded, around), axis=1), seen), _rows(extreme, seen))


def check_parity(network: Network, run: Run, inputs: Inputs) -> Differences:
    """Compare a network that was read back with the evaluator's policy, on all rows together and on one alone.

    Raises:
        ParityError: they differ by more than is allowed, or NaN is not where it has to be.
    """
    alone = {name: rows[:1] for name, rows in inputs.usual.items()}
    usual = [_difference(network, run, rows, TOLERANCE) for rows in (inputs.usual, alone)]
    return Differences(max(usual), _difference(network, run, inputs.extreme, EXTREME_TOLERANCE))


def _rows(pairs: NDArray[np.floating], seen: Layouts) -> Rows:
    """Rows of (2, N, O) observations: one step ago, and now."""
    previous, now = pairs.astype(np.float32)
    num = seen.positions.size
    return {"observation": now, "positions": now[:, :num], "previous_positions": previous[:, :num]}


def _difference(network: Network, run: Run, inputs: Rows, tolerance: float) -> float:
    rows = [inputs[name] for name in network.inputs]
    expected, found = network.reference(*rows), run(*rows)
    greatest = 0.0
    for name, wanted in expected.items():
        here, shape = f"{network.name}: its {name}", (len(rows[0]), *network.outputs[name])
        if found[name].shape != shape:
            raise ParityError(f"{here} has shape {found[name].shape}, not {shape}: nothing was written")
        if not np.array_equal(np.isnan(found[name]), np.isnan(wanted)):
            raise ParityError(f"{here} is NaN where the policy's is not, or the reverse: nothing was written")
        difference = float(np.nanmax(np.abs(found[name] - wanted)))
        if difference > tolerance:
            raise ParityError(
                f"{here} differs from the policy's by {difference:.2g}, which is more than {tolerance:g}: nothing was "
                "written; another --format may do"
            )
        greatest = max(greatest, difference)
    return greatest
