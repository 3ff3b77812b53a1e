"""Manifests: the description of a version, as JSON that carries its own digest.

Of the configuration in it, only how the policy acts and is evaluated is read. So versions that any tandem has published
load for ever, whatever keys learning has had.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import Field, JsonValue, StrictInt, ValidationError

from service.base.errors import DamagedBlobError, FormatVersionError, RegistryError
from service.base.files import os_errors, read_regular
from service.base.parsing import ParseError, parse_json
from service.config import Config, parse_config
from service.config.frozen import FrozenModel, first_error
from service.config.tree import group_of

FORMAT_VERSION = 1
MAX_BYTES = 4 * 1024 * 1024
"""Of a manifest; usual are ten thousand."""
ACTING = (
    "name",
    "world",
    "policy",
    "game.success_distance_m",
    "game.bob_steps",
    "game.bob_hold_steps",
    "skills.method",
    "skills.prior",
    "skills.zero_shot",
    "skills.size",
    "skills.episode_steps",
    "skills.hidden_sizes",
    "skills.sac.hidden_sizes",
    "run.evaluation_steps",
)
"""Keys of a published configuration that are read; versions of before must have them by these names."""
_DIGEST_KEY = "manifest_sha256"
_MEND = "restore the file from a copy, or publish the version again"


class TensorDescription(FrozenModel):
    """Shape and dtype of one tensor."""

    shape: tuple[StrictInt, ...]
    dtype: str


class Manifest(FrozenModel):
    """Everything known about one immutable version."""

    format_version: StrictInt = FORMAT_VERSION
    name: str
    version: StrictInt = Field(ge=1)
    created: str = Field(description="UTC, ISO 8601")
    blob_sha256: str = Field(pattern=r"^[0-9a-f]{64}$", description="digest of the safetensors bytes")
    blob_bytes: StrictInt = Field(ge=0)
    tensors: dict[str, TensorDescription]
    spaces: dict[str, JsonValue] = Field(description="the action and observation spaces")
    normalisation: dict[str, JsonValue] = Field(description="fixed normalisation of the network's input")
    config: dict[str, JsonValue] = Field(description="configuration of the run that made it")
    metrics: dict[str, float]
    parent: str | None = Field(None, description="NAME@VERSION this one was trained on from")
    history: dict[str, JsonValue] | None = Field(
        None, description="of its run: settings that changed on the way, and records that were lost; absent without"
    )
    git_commit: str | None = Field(None, description="of the code that published it; '-dirty' with local changes")

    @property
    def reference(self) -> str:
        """``NAME@VERSION``."""
        return f"{self.name}@{self.version}"

    def to_bytes(self) -> bytes:
        """The manifest as the JSON text that `parse_manifest` reads back to an equal object."""
        tree = self.model_dump(mode="json")
        if self.history is None:  # so that earlier versions read it, too
            del tree["history"]
        return (json.dumps({**tree, _DIGEST_KEY: _digest(tree)}, indent=1, sort_keys=True) + "\n").encode()


def make_manifest(fields: Mapping[str, object]) -> Manifest:
    """A manifest of these fields.

    Raises:
        RegistryError: a value that JSON cannot hold, such as NaN or an array; the message names it.
    """
    try:
        manifest = Manifest.model_validate(fields)
        json.dumps(manifest.model_dump(mode="json"), allow_nan=False)
    except ValidationError as error:
        raise RegistryError(
            f"manifest of {fields.get('name')}: {first_error(error)}; give finite JSON values"
        ) from None
    except ValueError:
        raise RegistryError(
            f"manifest of {fields.get('name')}: NaN or infinity in spaces, normalisation or config; leave it out"
        ) from None
    return manifest


def read_manifest(path: Path) -> Manifest:
    """Read and verify the manifest in a file.

    Raises:
        StorageError: it cannot be read; or as for ``parse_manifest``.
    """
    with os_errors("read", path):
        data = read_regular(path, MAX_BYTES, follow=True)
    return parse_manifest(data, path)


def parse_manifest(data: bytes, path: Path | str) -> Manifest:
    """Read and verify a manifest; ``path`` is named in errors.

    Raises:
        FormatVersionError: written in another format.
        DamagedBlobError: not the bytes that were published.
    """
    try:
        tree = parse_json(data, path)
    except ParseError as error:
        raise DamagedBlobError(f"manifest {path} is damaged: {error.reason}; {_MEND}") from None
    if not isinstance(tree, dict):
        raise DamagedBlobError(f"manifest {path} is damaged: not a JSON object; {_MEND}")
    if tree.get("format_version") != FORMAT_VERSION:
        raise FormatVersionError.of(path, found=tree.get("format_version"), supported=FORMAT_VERSION)
    expected, actual = tree.pop(_DIGEST_KEY, None), _digest(tree)
    if expected != actual:
        raise DamagedBlobError(f"manifest {path} is damaged: expected sha256 {expected}, it has {actual}; {_MEND}")
    try:
        return Manifest.model_validate(tree)
    except ValidationError as error:
        raise DamagedBlobError(f"manifest {path} is not valid: {first_error(error)}; {_MEND}") from None


def acting_config(tree: dict[str, Any], *, where: str) -> Config:
    """Read how a policy acts and is evaluated from a configuration that any version recorded.

    Only ``ACTING`` is read. All else has its defaults, since it may be of a version with other keys.

    Raises:
        ConfigError: a value of ``ACTING`` that no version has written.
    """
    acting: dict[str, Any] = {}
    for key in ACTING:
        *groups, last = key.split(".")
        found: Any = tree
        for name in groups:
            found = found.get(name) if isinstance(found, dict) else None
        if isinstance(found, dict) and last in found:
            group, name = group_of(acting, key, where=where)
            group[name] = found[last]
    if "skills" in acting:
        acting["method"] = "skills"
        acting.pop("policy", None)
        acting.pop("game", None)
    return parse_config(acting, where=where)


def _digest(tree: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(tree, sort_keys=True, separators=(",", ":")).encode()).hexdigest()
