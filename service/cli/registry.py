"""``tandem registry``: list, show, verify, alias, export, card; and ``tandem publish``, which fills it by hand."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import typer

from service.base.errors import RegistryError, StorageError, one_line
from service.base.files import write_atomic
from service.cli.common import (
    REGISTRY,
    ActsWithOption,
    CommandGroup,
    JsonOption,
    QuietOption,
    RegistryOption,
    loading,
    print_json,
    print_table,
)
from service.registry.bundled import BUNDLED, ExportedVersion, find_version, is_bundled
from service.registry.manifest import Manifest
from service.registry.names import check_alias
from service.registry.registry import Registry

registry_app = typer.Typer(
    name="registry", help="Frozen primitives: versions, aliases, export.", cls=CommandGroup, no_args_is_help=True
)

_Reference = Annotated[
    str,
    typer.Argument(
        help="NAME, NAME@VERSION or NAME@ALIAS; NAME is NAME@latest. Or the directory of an exported version."
    ),
]


def publish(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Directory of a run that no process is running.")],
    name: Annotated[str | None, typer.Option(help="Of what is published. Default: that of the run.")] = None,
    alias: Annotated[str | None, typer.Option(help="Make or move this alias, too.")] = None,
    primitives: ActsWithOption = None,
    registry: RegistryOption = REGISTRY,
    quiet: QuietOption = False,
) -> None:
    """Measure what a run has learned until now, and publish it: primitives, skills or a policy of a task."""
    with loading():
        from service.runs.train import publish_learned

    if alias is not None:
        check_alias(alias)
    version = publish_learned(run, registry, name, primitives)
    if alias is not None:
        Registry(registry).set_alias(version.name, alias, version.number)
    typer.echo(f"{version} is in {registry}")


@registry_app.command("list")
def list_versions(directory: RegistryOption = REGISTRY, as_json: JsonOption = False) -> None:
    """List every version: yours, and those that come with tandem (bundled)."""
    own, bundled = Registry(directory), Registry(BUNDLED)
    if not own.names():
        typer.echo(f"nothing published in {directory} yet", err=True)
    rows = []
    for registry in [own] if is_bundled(own) else [own, bundled]:
        for version in (version for name in registry.names() for version in registry.versions(name)):
            try:
                rows.append(_summary(registry, registry.manifest(str(version))))
            except StorageError as error:  # a damaged one must not hide the others
                typer.echo(f"{version}: {error}", err=True)
    if as_json:
        print_json(rows)
    elif rows:
        print_table(list(rows[0]), [[_text(value) for value in row.values()] for row in rows])


@registry_app.command()
def show(reference: _Reference, directory: RegistryOption = REGISTRY, as_json: JsonOption = False) -> None:
    """Show what a version says about itself."""
    registry, version = find_version(reference, directory)
    manifest = registry.manifest(str(version))
    summary = _summary(registry, manifest)
    tree = manifest.model_dump(mode="json")
    if as_json:
        print_json({**tree, "aliases": summary["aliases"], "where": summary["where"]})
        return
    tree["tensors"] = {name: f"{tensor.dtype} {list(tensor.shape)}" for name, tensor in manifest.tensors.items()}
    rows = [["reference", manifest.reference], ["aliases", _text(summary["aliases"])]]
    for key, value in tree.items():
        if isinstance(value, dict):
            rows += [[f"{key}.{inner}", _text(item)] for inner, item in value.items()]
        else:
            rows.append([key, _text(value)])
    print_table(["key", "value"], [*rows, ["where", summary["where"]]])


@registry_app.command()
def verify(
    reference: Annotated[str | None, typer.Argument(help="A version; everything when left out.")] = None,
    directory: RegistryOption = REGISTRY,
) -> None:
    """Check every byte against its digest, and every parameter; exit code 1 when something is damaged."""
    from service.registry.loading import network_problems

    if reference is not None:
        registry, version = find_version(reference, directory)
        problems = registry.verify(str(version), network_problems)
    elif directory.is_dir():
        problems = Registry(directory).verify(check=network_problems)
    else:
        raise RegistryError(f"no registry at {directory}; name one with --registry or TANDEM_REGISTRY")
    for problem in problems:
        typer.echo(one_line(problem), err=True)
    if problems:
        raise typer.Exit(1)
    typer.echo(f"{reference or directory}: all is well")


@registry_app.command()
def alias(
    reference: _Reference,
    alias: Annotated[str, typer.Argument(help="Such as champion.")],
    directory: RegistryOption = REGISTRY,
) -> None:
    """Make or move an alias to a version."""
    registry, version = find_version(reference, directory)
    registry.set_alias(version.name, alias, version.number)
    typer.echo(f"{version.name}@{alias} is now {version}")


@registry_app.command()
def export(
    reference: _Reference,
    target: Annotated[Path, typer.Argument(metavar="DIRECTORY", help="Made when missing.")],
    directory: RegistryOption = REGISTRY,
) -> None:
    """Write a version as two files that need no registry; every command takes their directory as a version."""
    registry, version = find_version(reference, directory)
    manifest = registry.export(str(version), target)
    typer.echo(f"{manifest.reference} is in {target}")


@registry_app.command()
def card(
    reference: _Reference,
    out: Annotated[Path | None, typer.Option(metavar="FILE", help="Such as README.md; default: stdout.")] = None,
    licence: Annotated[
        str, typer.Option("--license", metavar="ID", help="Of the parameters, as hubs write it.")
    ] = "apache-2.0",
    directory: RegistryOption = REGISTRY,
) -> None:
    """Write a model card for a hub: what a version is, how it was trained, how good it is, how to load it."""
    from service.registry.card import model_card

    registry, version = find_version(reference, directory)
    text = model_card(registry.manifest(str(version)), licence=licence)
    if out is None:
        typer.echo(text, nl=False)
        return
    write_atomic(out, text.encode())
    typer.echo(f"the card of {version} is in {out}")


def _summary(registry: Registry, manifest: Manifest) -> dict[str, Any]:
    """A version's row in the list; two registries may both have a version 1, so it says where this one is."""
    exported = isinstance(registry, ExportedVersion)
    return {
        "name": manifest.name,
        "version": manifest.version,
        "where": "bundled" if is_bundled(registry) else "exported" if exported else "yours",
        "created": manifest.created,
        "bytes": manifest.blob_bytes,
        "aliases": [name for name, number in registry.aliases(manifest.name).items() if number == manifest.version],
        "parent": manifest.parent,
        "kind": manifest.spaces.get("kind", "primitives"),
    }


def _text(value: Any) -> str:
    if value is None or value == []:
        return "-"
    if isinstance(value, list) and all(isinstance(item, str) for item in value):
        return ", ".join(value)
    return value if isinstance(value, str) else json.dumps(value)
