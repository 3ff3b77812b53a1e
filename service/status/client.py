"""Primitives over HTTP: fetched once, verified, and kept in a registry on disk. Does not import torch."""

from __future__ import annotations

import hashlib
import json
import os
from pathlib import Path
from typing import Any

from service.errors import TandemError
from service.io.files import os_errors, write_atomic
from service.registry.blobs import BlobStore, check_digest
from service.registry.errors import DamagedBlobError, UnknownVersionError
from service.registry.manifest import Manifest, parse_manifest
from service.registry.names import Version, split_reference
from service.registry.registry import Registry
from service.status.errors import FetchError, StatusError, WrongTokenError
from service.status.token import VARIABLE, read_token

try:
    import httpx
except ImportError:
    raise TandemError(
        "fetching primitives needs the package httpx, which is not installed: pip install 'tandem-skills[cluster]'"
    ) from None

MAX_MANIFEST_BYTES = 16 * 1024 * 1024
_MAX_PROBLEM_BYTES = 64 * 1024
_TIMEOUT = httpx.Timeout(20.0, connect=5.0)


def fetch_primitives(
    url: str, reference: str, *, token: str | None = None, cache_dir: Path | None = None
) -> tuple[Registry, Version]:
    """Fetch a version from a status service.

    An alias is resolved by the service each time; parameters are fetched only once.

    Args:
        url: URL of the service, such as ``http://lab:8321``.
        reference: NAME, NAME@VERSION or NAME@ALIAS.
        token: token of the service; None for that of ``TANDEM_TOKEN``.
        cache_dir: directory of fetched registries; None for ``~/.cache/tandem/registries``.

    Returns:
        A registry on this machine that has the version, and the version: ``registry.load(str(version))``.

    Raises:
        UnknownVersionError: the service has no such version.
        DamagedBlobError: the received bytes do not match their digest, and are not kept.
        WrongTokenError: the service needs a token, or another one.
        FetchError: the service cannot be reached, or something else listens at the URL.
        RegistryError: not a reference, or the cache cannot be written.
    """
    base = _base_url(url)
    name, target = split_reference(reference)
    directory = hashlib.sha256(base.encode()).hexdigest()[:16]  # one for each service: two may both have a version 1
    registry = Registry((cache_dir or _default_cache()) / directory)
    token = read_token() if token is None else token
    headers = {"Authorization": f"Bearer {token}"} if token else {}
    with httpx.Client(base_url=base, headers=headers, timeout=_TIMEOUT) as client:
        data = _get(client, f"/v1/primitives/{name}/versions/{target}", MAX_MANIFEST_BYTES)
        manifest = parse_manifest(data, _named(f"{name}@{target}", client))
        if manifest.name != name or (isinstance(target, int) and manifest.version != target):
            raise DamagedBlobError(
                f"{base} gave the manifest of {manifest.reference} for {reference}; check its registry"
            )
        _keep(client, manifest, registry)
    path = registry.root / "models" / name / "versions" / str(manifest.version)
    with os_errors("write", path):  # after its parameters: a version that is listed can be loaded
        write_atomic(path, manifest.to_bytes())
    return registry, Version(name, manifest.version)


def _keep(client: httpx.Client, manifest: Manifest, registry: Registry) -> None:
    """Fetch the parameters unless the cache has them undamaged."""
    digest = manifest.blob_sha256
    blobs = BlobStore(registry.root / "blobs")
    try:
        blobs.get(digest)
    except DamagedBlobError:  # or not there yet
        data = _get(client, f"/v1/blobs/sha256/{digest}", manifest.blob_bytes)
        check_digest(_named(manifest.reference, client), data, digest)
        blobs.put(data)


def _named(what: str, client: httpx.Client) -> Path:
    """A name for error messages, such as ``panda-cube@3 from lab:8321``."""
    return Path(f"{what} from {client.base_url.netloc.decode()}")


def _get(client: httpx.Client, path: str, max_bytes: int) -> bytes:
    """The body of a successful answer of at most ``max_bytes``."""
    base = str(client.base_url).rstrip("/")
    try:
        with client.stream("GET", path) as response:
            limit, data = max_bytes if response.is_success else _MAX_PROBLEM_BYTES, b""
            for chunk in response.iter_bytes():
                data += chunk
                if len(data) > limit:
                    raise DamagedBlobError(
                        f"{base}{path} gave more than {limit} bytes, which is too long; check its registry"
                    )
    except httpx.TimeoutException:
        raise FetchError(f"{base} does not answer in time; is `tandem serve` well there? Try again") from None
    except httpx.RequestError as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise FetchError(f"cannot reach {base}: {reason}; is `tandem serve` running there?") from None
    if response.status_code != httpx.codes.OK:
        raise _refusal(base, path, response, data)
    return data


def _refusal(base: str, path: str, response: httpx.Response, data: bytes) -> TandemError:
    problem = _problem(response, data)
    detail = " ".join(str(problem.get("detail", "")).split())[:500]
    match response.status_code:
        case 401:
            wanted = "a token" if problem.get("type") == "urn:tandem:missing-token" else "another token"
            return WrongTokenError(
                f"{base} wants {wanted}: set {VARIABLE} to the one it was started with, or give token="
            )
        case 404 if problem.get("type") == "urn:tandem:unknown-version":
            return UnknownVersionError(f"{base} says: {detail}")
        case 500 if problem.get("type") == "urn:tandem:damaged":
            return DamagedBlobError(f"{base} says: {detail}")
    if not problem:
        kind = response.headers.get("content-type", "nothing")
        return FetchError(
            f"{base}{path} gave {response.status_code} and {kind[:60]}: is this the URL of a `tandem serve`?"
        )
    return FetchError(f"{base}{path} gave {response.status_code}: {detail}")


def _problem(response: httpx.Response, data: bytes) -> dict[str, Any]:
    """The problem in the answer; empty if it is something else."""
    try:
        tree = json.loads(data)
    except ValueError:
        return {}
    is_problem = response.headers.get("content-type", "").startswith("application/problem+json")
    return tree if is_problem and isinstance(tree, dict) else {}


def _base_url(url: str) -> str:
    """Check a URL and remove the slash at its end.

    Raises:
        StatusError: not the URL of a service; the message does not quote a password in it.
    """
    try:
        parsed = httpx.URL(url)
    except (httpx.InvalidURL, TypeError):
        raise StatusError("the registry's URL cannot be read; write http://HOST:PORT") from None
    if parsed.userinfo:
        raise StatusError(f"leave the password out of the URL of {parsed.host}; set {VARIABLE} to the service's token")
    if parsed.scheme not in ("http", "https") or not parsed.host or parsed.query or parsed.fragment:
        raise StatusError(f"{url!r} is not the URL of a status service; write http://HOST:PORT")
    return str(parsed).rstrip("/")


def _default_cache() -> Path:
    root = os.environ.get("XDG_CACHE_HOME", "")
    home = Path(root) if root and Path(root).is_absolute() else Path.home() / ".cache"
    return home / "tandem" / "registries"
