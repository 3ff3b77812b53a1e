"""The services of a compose file as Docker Compose reads them: variables put in, secrets and mounts looked up.

A key of a service that is not known here is an error. Of the keys below it only those are read that are needed here.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from service.base.errors import TandemError

KEYS = {
    "build", "cap_drop", "command", "depends_on", "deploy", "entrypoint", "environment", "healthcheck", "image", "init",
    "logging", "ports", "profiles", "read_only", "restart", "secrets", "security_opt", "shm_size", "stop_grace_period",
    "tmpfs", "user", "volumes",
}  # fmt: skip
"""Keys of a service that are known here."""
SHARED = {
    "init": True, "cap_drop": ["ALL"], "security_opt": ["no-new-privileges:true"], "restart": "unless-stopped"
}  # fmt: skip
"""What every service has, and every container is given."""
_VARIABLE = re.compile(r"\$(?:(?P<escaped>\$)|\{(?P<name>\w+)(?::(?P<how>[-?])(?P<rest>[^}]*))?\})")
_SIZES = {"kb": 2**10, "mb": 2**20, "gb": 2**30, "k": 2**10, "m": 2**20, "g": 2**30}


class Mount(NamedTuple):
    """A file or directory of the machine, or a volume by its name, in a container."""

    source: Path | str
    target: str
    read_only: bool


class Port(NamedTuple):
    """A port of a container that the machine has, too."""

    address: str
    outside: int
    inside: int


class Dependency(NamedTuple):
    """A service that another waits for, until it is there or healthy."""

    service: str
    healthy: bool


@dataclass(frozen=True, slots=True)
class Service:
    """A service, with every value that its containers get."""

    name: str
    image: str
    entrypoint: Sequence[str] | None
    """None for the image's."""
    command: Sequence[str] | None
    environment: Mapping[str, str]
    user: str | None
    mounts: Sequence[Mount]
    tmpfs: Sequence[str]
    secrets: Mapping[str, str]
    ports: Sequence[Port]
    depends_on: Sequence[Dependency]
    health: Sequence[str] | None
    """The command of its health check."""
    num_containers: int
    memory_bytes: int | None
    shm_bytes: int
    stop_grace_s: float
    read_only: bool
    profiles: Sequence[str]


def read_services(path: Path, variables: Mapping[str, str]) -> dict[str, Service]:
    """Read the services of a compose file in the order in which they have to be started.

    Args:
        path: the compose file; its relative paths begin at its directory.
        variables: those of ``.env``.
    """
    tree = _with_variables(yaml.safe_load(path.read_text(encoding="utf-8")), variables)
    values = {name: variables[each["environment"]] for name, each in tree["secrets"].items()}
    found = {name: _service(name, each, path.parent, values) for name, each in tree["services"].items()}
    for service in found.values():
        for mount in service.mounts:
            if isinstance(mount.source, str) and mount.source not in tree["volumes"]:
                raise TandemError(f"{path}: {service.name} mounts the volume {mount.source}, which is not listed")
    ordered: dict[str, Service] = {}
    while len(ordered) < len(found):
        left = [each for name, each in found.items() if name not in ordered]
        ready = [each for each in left if all(other.service in ordered for other in each.depends_on)]
        if not ready:
            raise TandemError(f"{path}: services wait for each other: {', '.join(each.name for each in left)}")
        ordered |= {each.name: each for each in ready}
    return ordered


def read_variables(path: Path) -> dict[str, str]:
    """The variables of an ``.env`` file."""
    return dict(re.findall(r"^(\w+)=(.*)$", path.read_text(encoding="utf-8"), re.MULTILINE))


def _service(name: str, tree: Mapping[str, Any], directory: Path, secrets: Mapping[str, str]) -> Service:
    if unknown := tree.keys() - KEYS:
        raise TandemError(f"service {name}: {', '.join(sorted(unknown))} is not known here; add it to {__name__}")
    if differing := [key for key, value in SHARED.items() if tree.get(key) != value]:
        raise TandemError(f"service {name}: {differing[0]} is not {SHARED[differing[0]]}, as of all others")
    deploy = tree.get("deploy", {})
    limits = deploy.get("resources", {}).get("limits", {})
    if tree.get("read_only") and tree.get("secrets"):
        raise TandemError(f"service {name}: Compose copies secrets into a container, so not into a read_only one")
    depends_on = tree.get("depends_on", {})
    if isinstance(depends_on, list):
        depends_on = {each: {} for each in depends_on}
    how, *words = tree.get("healthcheck", {}).get("test", [""])
    return Service(
        name=name,
        image=tree["image"],
        entrypoint=tree.get("entrypoint"),
        command=tree.get("command"),
        environment={key: str(value) for key, value in tree.get("environment", {}).items()},
        user=tree.get("user"),
        mounts=[_mount(text, directory) for text in tree.get("volumes", [])],
        tmpfs=tree.get("tmpfs", []),
        secrets={each: secrets[each] for each in tree.get("secrets", [])},
        ports=[_port(text) for text in tree.get("ports", [])],
        depends_on=[Dependency(name, each.get("condition") == "service_healthy") for name, each in depends_on.items()],
        health=["/bin/sh", "-c", *words] if how == "CMD-SHELL" else words or None,
        num_containers=int(deploy.get("replicas", 1)),
        memory_bytes=_bytes(limits["memory"]) if "memory" in limits else None,
        shm_bytes=_bytes(tree.get("shm_size", "64mb")),
        stop_grace_s=float(tree.get("stop_grace_period", "10s").removesuffix("s")),
        read_only=tree.get("read_only", False),
        profiles=tree.get("profiles", []),
    )


def _with_variables(tree: Any, variables: Mapping[str, str]) -> Any:
    if isinstance(tree, dict):
        return {key: _with_variables(value, variables) for key, value in tree.items()}
    if isinstance(tree, list):
        return [_with_variables(value, variables) for value in tree]
    return _VARIABLE.sub(lambda match: _value(match, variables), tree) if isinstance(tree, str) else tree


def _value(match: re.Match[str], variables: Mapping[str, str]) -> str:
    if match["escaped"]:
        return "$"
    value = variables.get(match["name"], "")
    if not value and match["how"] == "?":
        raise TandemError(f"{match['name']}: {match['rest']}")
    return value or (match["rest"] if match["how"] == "-" else "")


def _mount(text: str, directory: Path) -> Mount:
    source, target, *options = text.split(":")
    return Mount((directory / source).resolve() if source.startswith(".") else source, target, options == ["ro"])


def _port(text: str) -> Port:
    address, outside, inside = text.split(":")
    return Port(address, int(outside), int(inside))


def _bytes(text: str) -> int:
    number, unit = re.fullmatch(r"(\d+)([a-z]*)", text.lower()).groups()  # type: ignore[union-attr]
    return int(number) * _SIZES.get(unit, 1)
