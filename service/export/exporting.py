"""Exports a policy into a folder that needs nothing of Tandem; the folder appears when everything in it is tried."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from service.base.errors import ExportError
from service.base.files import new_directory, os_errors
from service.base.tensors import digest_of
from service.envs.observations import layouts
from service.export.describing import describe
from service.export.description import FILE, Description
from service.export.formats import find_format
from service.export.measurements import measure
from service.export.networks import Network, network_of_orchestrator, networks_of_bob, networks_of_primitives
from service.export.parity import check_parity, make_inputs
from service.export.readme import make_readme
from service.registry.learned import LearnedPolicy
from service.registry.loading import Trained

Part = Literal["all", "policy", "primitives"]
PARTS: tuple[Part, ...] = ("all", "policy", "primitives")
"""What of a policy is exported: all that there is, the policy without its primitives one by one, or only those."""


def export(
    trained: Trained, format_name: str, folder: Path, *, part: Part = "all", num_episodes: int = 100
) -> Description:
    """Write a policy into a new folder, try what was written, and describe it.

    Args:
        trained: the policy.
        format_name: ``onnx``, ``numpy`` or ``torchscript``.
        folder: that is made.
        part: one of ``PARTS``.
        num_episodes: played to measure, for each delay.

    Raises:
        ExportError: no such part, see ``networks_of``; no such format, or packages for it are missing.
        ParityError: what was written does not compute what the evaluator's policy does; nothing is left.
        StorageError: the folder is there already, or cannot be written.
    """
    chosen, found = find_format(format_name), networks_of(trained, part)
    trained, frozen = trained.nominal, trained.trained
    with new_directory(folder) as temporary:
        measured, observations = measure(trained, num_episodes)
        inputs = make_inputs(observations, layouts(trained.world))
        with os_errors("write", temporary):
            chosen.shared(temporary)
        networks = {}
        for network in found:
            path = temporary / f"{network.name}{chosen.ending}"
            with os_errors("write", path):
                chosen.write(network, path)
            networks[path.name] = network, check_parity(network, chosen.read(network, path), inputs)
        description = describe(
            trained.name if frozen is None else f"{trained.name} with {frozen.name}",
            trained.world,
            networks,
            measured,
            format_name=format_name,
            task=trained.task,
            success_distance_m=trained.success_distance_m,
            digests=_digests(trained),
        )
        with os_errors("write", temporary):
            (temporary / FILE).write_text(description.model_dump_json(indent=1) + "\n", encoding="utf-8")
            (temporary / "README.md").write_text(make_readme(description), encoding="utf-8")
    return description


def networks_of(trained: Trained, part: Part) -> list[Network]:
    """The networks of a policy.

    Raises:
        TandemError: no such part; skills; or a policy that composes no primitives.
    """
    if part not in PARTS:
        raise ExportError(f"unknown part {part!r}; choose one of {', '.join(PARTS)}")
    trained.expect("primitives", "orchestrator", by="tandem export")
    networks: list[Network] = []
    if trained.kind == "orchestrator":
        frozen = trained.trained
        if frozen is None or frozen.kind != "primitives" or not isinstance(trained.policy, LearnedPolicy):
            raise ExportError(
                f"{trained.label} was trained with a method that composes no primitives: export one of ours"
            )
        if part != "primitives":
            networks.append(network_of_orchestrator(trained))
        return networks + (networks_of_primitives(frozen) if part != "policy" else [])
    if part != "primitives":
        networks += networks_of_bob(trained)
    if part == "primitives" or (part == "all" and networks[0].function == "bob"):
        networks += networks_of_primitives(trained)
    return networks


def _digests(trained: Trained) -> dict[str, str]:
    if trained.trained is None:
        return {"policy": digest_of("", trained.parameters)}
    parts = {"orchestrator": trained, "primitives": trained.trained}
    return {name: digest_of("", each.parameters) for name, each in parts.items()}
