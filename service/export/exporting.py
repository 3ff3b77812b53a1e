"""Exports a policy into a folder that needs nothing of Tandem; the folder appears when everything in it is tried."""

from __future__ import annotations

import json
from pathlib import Path

from service.base.errors import ExportError
from service.base.files import new_directory, os_errors
from service.envs.observations import layouts
from service.export.describing import Description, describe, make_readme
from service.export.formats import find_format
from service.export.measurements import measure
from service.export.networks import Network, network_of_bob, network_of_orchestrator, networks_of_primitives
from service.export.parity import check_parity, make_inputs
from service.registry.loading import Trained

PARTS = ("all", "policy", "primitives")
"""What of a policy is exported: all that there is, the policy without its primitives one by one, or only those."""


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
        ExportError: no such part, see ``networks_of``; no such format, or packages for it are missing.
        ParityError: what was written does not compute what the evaluator's policy does; nothing is left.
        StorageError: the folder is there already, or cannot be written.
    """
    chosen, found = find_format(format_name), networks_of(trained, part)
    trained = trained.nominal
    with new_directory(folder) as temporary, os_errors("write", temporary):
        measured, observations = measure(trained, num_episodes)
        inputs = make_inputs(observations, layouts(trained.world))
        networks = {}
        for network in found:
            path = temporary / f"{network.name}{chosen.ending}"
            chosen.write(network, path)
            networks[path.name] = network, check_parity(network, chosen.read(network, path), inputs)
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
        raise ExportError(f"unknown part {part!r}; choose one of {', '.join(PARTS)}")
    trained.expect("primitives", "orchestrator", by="tandem export")
    frozen = trained
    if trained.kind == "orchestrator":
        if trained.trained is None or trained.trained.kind != "primitives":
            raise ExportError(
                f"{trained.label} was trained with a method that composes no primitives: export one of ours"
            )
        frozen = trained.trained
    networks = []
    if part != "primitives":
        networks.append(network_of_bob(trained) if frozen is trained else network_of_orchestrator(trained))
    if part == "primitives" or (part == "all" and networks[0].function != "monolithic"):
        networks += networks_of_primitives(frozen)
    return networks
