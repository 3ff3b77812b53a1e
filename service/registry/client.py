"""Primitives over HTTP: fetched once, verified, and kept in a registry on disk. Does not import torch."""

from __future__ import annotations

import asyncio
import hashlib
import os
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Any

from service.base.errors import (
    DamagedBlobError,
    FetchError,
    StatusError,
    TandemError,
    UnknownVersionError,
    WrongTokenError,
    one_line,
)
from service.base.extras import needs_extra
from service.base.files import os_errors, write_atomic
from service.base.parsing import ParseError, parse_json
from service.registry.blobs import BlobStore, check_digest
from service.registry.manifest import Manifest, parse_manifest
from service.registry.names import Version, split_reference
from service.registry.registry import Registry
from service.registry.token import VARIABLE, read_token

with needs_extra("serve", "fetching primitives"):
    import httpx

MAX_MANIFEST_BYTES = 4 * 1024 * 1024
MAX_BLOB_BYTES = 256 * 1024 * 1024
"""Of parameters, whatever a service says; those of the recipe have 711 kB."""
DEADLINE_S = 300.0
"""Of one answer, from the question to its last byte."""
URL_VARIABLE, REGISTRY_VARIABLE = "TANDEM_URL", "TANDEM_REGISTRY"
"""Variables that name the service which ``TANDEM_TOKEN`` is for."""
_MAX_PROBLEM_BYTES = 64 * 1024
_TIMEOUT = httpx.Timeout(20.0, connect=5.0)
_PLAIN = {"Accept-Encoding": "identity"}


def fetch_primitives(
    url: str, reference: str, *, token: str | None = None, cache_dir: Path | None = None
) -> tuple[Registry, Version]:
    """Fetch a version from a status service.

    An alias is resolved by the service each time; parameters are fetched only once.

    Args:
        url: URL of the service, such as ``http://lab:8321``.
        reference: NAME, NAME@VERSION or NAME@ALIAS.
        token: token of the service; None for that of ``TANDEM_TOKEN``, which is sent only to the service that
            ``TANDEM_URL`` or ``TANDEM_REGISTRY`` names.
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
    if token is None and _is_configured(base):
        token = read_token()
    service = _Service(base, token)
    data = service.get(f"/v1/primitives/{name}/versions/{target}", MAX_MANIFEST_BYTES)
    manifest = parse_manifest(data, service.named(f"{name}@{target}"))
    if manifest.name != name or (isinstance(target, int) and manifest.version != target):
        raise DamagedBlobError(f"{base} gave the manifest of {manifest.reference} for {reference}; check its registry")
    _keep(service, manifest, registry)
    path = registry.root / "models" / name / "versions" / str(manifest.version)
    with os_errors("write", path):  # after its parameters: a version that is listed can be loaded
        write_atomic(path, manifest.to_bytes())
    return registry, Version(name, manifest.version)


class _Service:
    """The status service at a URL."""

    def __init__(self, base: str, token: str | None) -> None:
        self._base = base
        self._headers = _PLAIN | ({"Authorization": f"Bearer {token}"} if token else {})

    def named(self, what: str) -> Path:
        """A name for error messages, such as ``panda-cube@3 from lab:8321``."""
        return Path(f"{what} from {httpx.URL(self._base).netloc.decode()}")

    def get(self, path: str, max_bytes: int) -> bytes:
        """The body of a successful answer of at most ``max_bytes``, which may take ``DEADLINE_S`` in all."""
        with ThreadPoolExecutor(1) as thread:  # the caller may have an event loop of its own, as notebooks do
            response, data = thread.submit(asyncio.run, self._ask(path, max_bytes)).result()
        if response.status_code != httpx.codes.OK:
            raise _refusal(self._base, path, response, data)
        return data

    async def _ask(self, path: str, max_bytes: int) -> tuple[httpx.Response, bytes]:
        data = bytearray()
        try:
            async with (
                asyncio.timeout(DEADLINE_S),
                httpx.AsyncClient(base_url=self._base, headers=self._headers, timeout=_TIMEOUT) as client,
                client.stream("GET", path) as response,
            ):
                limit = max_bytes if response.is_success else _MAX_PROBLEM_BYTES
                async for chunk in response.aiter_raw():  # never unpacked: a small answer could become a huge one
                    data += chunk
                    if len(data) > limit:
                        raise DamagedBlobError(
                            f"{self._base}{path} gave more than {limit} bytes, which is too long; check its registry"
                        )
        except (TimeoutError, httpx.TimeoutException):
            raise FetchError(f"{self._base} does not answer in time; is `tandem serve` well there? Try again") from None
        except httpx.RequestError as error:
            raise FetchError(f"cannot reach {self._base}: {_reason(error)}; is `tandem serve` running there?") from None
        return response, bytes(data)


def _keep(service: _Service, manifest: Manifest, registry: Registry) -> None:
    """Fetch the parameters unless the cache has them undamaged."""
    digest = manifest.blob_sha256
    blobs = BlobStore(registry.root / "blobs")
    try:
        blobs.get(digest)
    except DamagedBlobError:  # or not there yet
        data = service.get(f"/v1/blobs/sha256/{digest}", min(manifest.blob_bytes, MAX_BLOB_BYTES))
        check_digest(service.named(manifest.reference), data, digest)
        blobs.put(data)


def _reason(error: BaseException) -> str:
    """The reason in the innermost error, such as that the connection was refused."""
    while (cause := error.__cause__ or error.__context__) is not None:
        error = cause.exceptions[0] if isinstance(cause, BaseExceptionGroup) else cause
    text = os.strerror(error.errno) if isinstance(error, OSError) and error.errno else str(error)
    return one_line(text, 500) or type(error).__name__


def _is_configured(base: str) -> bool:
    """Whether the environment names this very service, so that the environment's token is for it."""
    named = (os.environ.get(variable, "") for variable in (URL_VARIABLE, REGISTRY_VARIABLE))
    for url in filter(None, named):
        with suppress(StatusError):
            if _base_url(url) == base:
                return True
    return False


def _refusal(base: str, path: str, response: httpx.Response, data: bytes) -> TandemError:
    problem = _problem(response, data)
    detail = one_line(str(problem.get("detail", "")), 500)
    match response.status_code:
        case 401:
            wanted = "a token" if problem.get("type") == "urn:tandem:missing-token" else "another token"
            return WrongTokenError(
                f"{base} wants {wanted}: set {VARIABLE} to the one it was started with and {URL_VARIABLE} to this URL, "
                "or give token="
            )
        case 404 if problem.get("type") == "urn:tandem:unknown-version":
            return UnknownVersionError(f"{base} says: {detail}")
        case 500 if problem.get("type") == "urn:tandem:damaged":
            return DamagedBlobError(f"{base} says: {detail}")
    if not problem:
        kind = response.headers.get("content-type", "nothing")
        return FetchError(
            f"{base}{path} gave {response.status_code} and {one_line(kind, 60)}: is this the URL of a `tandem serve`?"
        )
    return FetchError(f"{base}{path} gave {response.status_code}: {detail}")


def _problem(response: httpx.Response, data: bytes) -> dict[str, Any]:
    """The problem in the answer; empty if it is something else."""
    try:
        tree = parse_json(data, "the answer")
    except ParseError:
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
