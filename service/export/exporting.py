"""Exports a policy into a folder that needs nothing of Tandem; the folder appears when everything in it is tried.

The parity test: what was written computes what the evaluator's policy does, or is not left behind. Both compute in
float32, in which the order of a sum matters. Where the policy has learned, that is a few millionths. With inputs that
are all at their clips its own rounding error is up to 2e-5, so there more is allowed.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from service.base.errors import ParityError, TandemError
from service.base.files import new_directory, os_errors
from service.base.types import FloatArray
from service.envs.observations import Layouts, layouts
from service.export.describing import Description, describe, make_readme
from service.export.formats import Run, find_format
from service.export.measurements import measure
from service.export.networks import Network, network_of_bob, network_of_orchestrator, network_of_primitive
from service.registry.loading import Trained

PARTS = ("all", "policy", "primitives")
"""What of a policy is exported: all that there is, the policy without its primitives one by one, or only those."""
TOLERANCE, EXTREME_TOLERANCE = 1e-5, 1e-4
"""Greatest absolute difference of an output: at recorded inputs and around them, and at extreme ones."""
_NUM_ROWS = 1000
"""Of each kind: recorded, around those, and extreme."""
_BEYOND_CLIP = 8.0
"""Extreme inputs are up to so many scales from their offsets; networks clip at 5."""
_FAR = 1e4

Rows = Mapping[str, FloatArray]
"""(N, size) rows by the networks' names of inputs."""


def export(
    trained: Trained, format_name: str, folder: Path, *, part: str = "all", num_episodes: int = 100
) -> Description:
    """Write a policy into a new folder, try what was written, and describe it.

    Args:
        trained: the policy.
        format_name: ``onnx``, ``numpy`` or ``torchscript``.
        folder: that is made.
        part: one of ``PARTS``.
        num_episodes: played to measure, for each delay.

    Returns:
        What ``policy.json`` of the folder says.

    Raises:
        TandemError: no such part, see ``networks_of``; no such format, or packages for it are missing.
        ParityError: what was written does not compute what the evaluator's policy does; nothing is left.
        StorageError: the folder is there already, or cannot be written.
    """
    chosen, found = find_format(format_name), networks_of(trained, part)
    trained = trained.nominal
    with new_directory(folder) as temporary, os_errors("write", temporary):
        measured, observations = measure(trained, num_episodes)
        usual, extreme = make_inputs(observations, layouts(trained.world))
        networks = {}
        for network in found:
            path = temporary / f"{network.name}{chosen.ending}"
            chosen.write(network, path)
            networks[path.name] = network, check_parity(network, chosen.read(network, path), usual, extreme)
        description = describe(trained, format_name, networks, measured)
        (temporary / "policy.json").write_text(json.dumps(description, indent=1) + "\n", encoding="utf-8")
        (temporary / "README.md").write_text(make_readme(description, observations[0, 0]), encoding="utf-8")
    return description


def networks_of(trained: Trained, part: str) -> list[Network]:
    """The networks of a policy.

    Raises:
        TandemError: no such part; skills; or a policy that composes no primitives.
    """
    if part not in PARTS:
        raise TandemError(f"unknown part {part!r}; choose one of {', '.join(PARTS)}")
    trained.expect("primitives", "orchestrator", by="tandem export")
    frozen = trained
    if trained.kind == "orchestrator":
        if trained.acts_with is None or trained.acts_with.kind != "primitives":
            raise TandemError(
                f"{trained.label} was trained with a method that composes no primitives: export one of ours"
            )
        frozen = trained.acts_with
    networks = []
    if part != "primitives":
        networks.append(network_of_bob(trained) if frozen is trained else network_of_orchestrator(trained))
    if part == "primitives" or (part == "all" and networks[0].function != "monolithic"):
        networks += [network_of_primitive(frozen, number) for number in range(frozen.primitives.num_primitives)]
    return networks


def make_inputs(observations: FloatArray, seen: Layouts) -> tuple[Rows, Rows]:
    """Make inputs to compare at, of (T, E, O) observations that were recorded: T steps of E episodes.

    Returns:
        Usual ones: recorded, and random ones up to one scale around them, 12 cm for a place. And extreme ones: random
        ones up to beyond where networks clip, some that are far out, and NaN in each number.
    """
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
    return _rows(np.concatenate((recorded, around), axis=1), seen), _rows(extreme, seen)


def check_parity(network: Network, run: Run, usual: Rows, extreme: Rows) -> tuple[float, float]:
    """Compare a network that was read back with the evaluator's policy, on all rows together and on one alone.

    Returns:
        Greatest absolute differences of any output, at usual and at extreme inputs.

    Raises:
        ParityError: they differ by more than is allowed, or NaN is not where it has to be.
    """
    alone = {name: rows[:1] for name, rows in usual.items()}
    found = max(_difference(network, run, rows, TOLERANCE) for rows in (usual, alone))
    return found, _difference(network, run, extreme, EXTREME_TOLERANCE)


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
