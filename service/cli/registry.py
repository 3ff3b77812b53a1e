"""``tandem registry``: list, show, verify, alias, export."""

from __future__ import annotations

import contextlib
import json
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from service.errors import TandemError

if TYPE_CHECKING:
    from service.registry.manifest import Manifest
    from service.registry.names import Version
    from service.registry.registry import Registry

registry_app = typer.Typer(name="registry", help="Frozen primitives: versions, aliases, export.", no_args_is_help=True)

_Directory = Annotated[
    Path, typer.Option("--registry", envvar="TANDEM_REGISTRY", metavar="DIR", help="Directory of the registry.")
]
_Reference = Annotated[str, typer.Argument(help="NAME, NAME@VERSION or NAME@ALIAS; NAME is NAME@latest.")]
_Json = Annotated[bool, typer.Option("--json", help="Print JSON.")]
_DEFAULT = Path("registry")


@registry_app.command("list")
def list_versions(directory: _Directory = _DEFAULT, as_json: _Json = False) -> None:
    """List every version: yours, and those that come with tandem (bundled)."""
    with _user_errors():
        from service.primitives.bundled import BUNDLED, is_bundled
        from service.registry.registry import Registry

        own, bundled = Registry(directory), Registry(BUNDLED)
        if not own.names():
            typer.echo(f"nothing published in {directory} yet", err=True)
        rows = [
            row
            for registry in ([own] if is_bundled(own) else [own, bundled])
            for name in registry.names()
            for row in _rows(registry, name)
        ]
    if as_json:
        typer.echo(json.dumps(rows, indent=1))
    elif rows:
        _print_table(list(rows[0]), [[_text(value) for value in row.values()] for row in rows])


@registry_app.command()
def show(reference: _Reference, directory: _Directory = _DEFAULT, as_json: _Json = False) -> None:
    """Show what a version says about itself."""
    with _user_errors():
        registry, version = _find(reference, directory)
        manifest = registry.manifest(str(version))
        aliases, where = _aliases_of(registry, manifest), _where(registry)
    if as_json:
        typer.echo(json.dumps({**manifest.model_dump(mode="json"), "aliases": aliases, "where": where}, indent=1))
    else:
        _print_table(["key", "value"], [*_describe(manifest, aliases), ["where", where]])


@registry_app.command()
def verify(
    reference: Annotated[str | None, typer.Argument(help="A version; everything when left out.")] = None,
    directory: _Directory = _DEFAULT,
) -> None:
    """Check every byte against its digest; exit code 1 when something is damaged."""
    with _user_errors():
        problems = _problems(reference, directory)
    for problem in problems:
        typer.echo(problem, err=True)
    if problems:
        raise typer.Exit(1)
    typer.echo(f"{reference or directory}: all is well")


@registry_app.command()
def alias(
    reference: _Reference,
    alias: Annotated[str, typer.Argument(help="Such as champion.")],
    directory: _Directory = _DEFAULT,
) -> None:
    """Make or move an alias to a version."""
    with _user_errors():
        registry, version = _find(reference, directory)
        registry.set_alias(version.name, alias, version.number)
    typer.echo(f"{version.name}@{alias} is now {version}")


@registry_app.command()
def export(
    reference: _Reference,
    target: Annotated[Path, typer.Argument(metavar="DIRECTORY", help="Made when missing.")],
    directory: _Directory = _DEFAULT,
) -> None:
    """Write a version as two files that need no registry."""
    with _user_errors():
        registry, version = _find(reference, directory)
        manifest = registry.export(str(version), target)
    typer.echo(f"{manifest.reference} is in {target}")


@contextlib.contextmanager
def _user_errors() -> Iterator[None]:
    try:
        yield
    except TandemError as error:
        typer.echo(f"error: {error}", err=True)
        raise typer.Exit(error.exit_code) from None


def _find(reference: str, directory: Path) -> tuple[Registry, Version]:
    from service.primitives.bundled import find_version

    return find_version(reference, directory)


def _problems(reference: str | None, directory: Path) -> list[str]:
    from service.registry.registry import Registry

    if reference is not None:
        registry, version = _find(reference, directory)
        return registry.verify(str(version))
    _check_there(directory)
    return Registry(directory).verify()


def _check_there(directory: Path) -> None:
    from service.registry.errors import RegistryError

    if not directory.is_dir():
        raise RegistryError(f"no registry at {directory}; name one with --registry or TANDEM_REGISTRY")


def _rows(registry: Registry, name: str) -> list[dict[str, object]]:

    rows: list[dict[str, object]] = []
    for version in registry.versions(name):
        manifest = registry.manifest(str(version))
        row = {"created": manifest.created, "bytes": manifest.blob_bytes, "aliases": _aliases_of(registry, manifest)}
        identity = {"name": name, "version": version.number, "where": _where(registry)}
        rows.append({**identity, **row, "parent": manifest.parent})
    return rows


def _where(registry: Registry) -> str:
    """Two registries may both have a version 1: which one is meant must be seen."""
    from service.primitives.bundled import is_bundled

    return "bundled" if is_bundled(registry) else "yours"


def _aliases_of(registry: Registry, manifest: Manifest) -> list[str]:
    return [alias for alias, number in registry.aliases(manifest.name).items() if number == manifest.version]


def _describe(manifest: Manifest, aliases: list[str]) -> list[list[str]]:
    tree = manifest.model_dump(mode="json")
    tree["tensors"] = {name: f"{tensor.dtype} {list(tensor.shape)}" for name, tensor in manifest.tensors.items()}
    rows: list[list[str]] = [["reference", manifest.reference], ["aliases", _text(aliases)]]
    for key, value in tree.items():
        if isinstance(value, dict):
            rows += [[f"{key}.{inner}", _text(item)] for inner, item in value.items()]
        else:
            rows.append([key, _text(value)])
    return rows


def _text(value: object) -> str:
    if value is None or value == []:
        return "-"
    if isinstance(value, list) and all(isinstance(item, str) for item in value):
        return ", ".join(value)
    return value if isinstance(value, str) else json.dumps(value)


def _print_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    if not _is_terminal():
        for row in (header, *rows):
            typer.echo("\t".join(row))
        return
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Column, Table

    table = Table(Column(header[0], no_wrap=True), *header[1:])  # what is typed again must stay in one piece
    for row in rows:
        table.add_row(*(escape(cell) for cell in row))
    Console().print(table)


def _is_terminal() -> bool:
    return sys.stdout.isatty()
