"""Primitives over HTTP: fetched once, verified, and kept in a registry on disk. Does not import torch."""

from __future__ import annotations

import hashlib
import os
from contextlib import suppress
from pathlib import Path

from service.base.errors import (
    DamagedBlobError,
    FetchError,
    StatusError,
    TandemError,
    UnknownVersionError,
    WrongTokenError,
    needs_extra,
    one_line,
)
from service.base.files import write_atomic
from service.base.parsing import ParseError, parse_json
from service.registry.manifest import parse_manifest
from service.registry.names import Version, split_reference
from service.registry.registry import Registry, check_digest
from service.registry.token import VARIABLE, read_token

with needs_extra("serve", "fetching primitives"):
    import httpx

URL_VARIABLE, REGISTRY_VARIABLE = "TANDEM_URL", "TANDEM_REGISTRY"
"""Variables that name the service which ``TANDEM_TOKEN`` is for."""
_TIMEOUT = httpx.Timeout(20.0, connect=5.0)


def fetch_primitives(url: str, reference: str) -> tuple[Registry, Version]:
    """Fetch a version from a status service into ``~/.cache/tandem/registries``.

    An alias is resolved by the service each time; parameters are fetched only once. The token of ``TANDEM_TOKEN`` is
    sent only to the service that ``TANDEM_URL`` or ``TANDEM_REGISTRY`` names.

    Args:
        url: URL of the service, such as ``http://lab:8321``.
        reference: NAME, NAME@VERSION or NAME@ALIAS.

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
    caches = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "tandem" / "registries"
    registry = Registry(caches / directory)
    configured = {os.environ.get(variable, "").rstrip("/") for variable in (URL_VARIABLE, REGISTRY_VARIABLE)}
    token = read_token() if base in configured else None  # it is for this service, not for any URL
    headers = {"Authorization": f"Bearer {token}"} if token else {}
    with httpx.Client(base_url=base, headers=headers, timeout=_TIMEOUT) as service:
        data = _get(service, f"/v1/primitives/{name}/versions/{target}")
        manifest = parse_manifest(data, f"{name}@{target} from {base}")
        if manifest.name != name or (isinstance(target, int) and manifest.version != target):
            raise DamagedBlobError(
                f"{base} gave the manifest of {manifest.reference} for {reference}; check its registry"
            )
        digest = manifest.blob_sha256
        try:
            registry.get_blob(digest)
        except DamagedBlobError:  # or not there yet
            data = _get(service, f"/v1/blobs/sha256/{digest}")
            check_digest(f"{manifest.reference} from {base}", data, digest)
            registry.put_blob(data)
    path = registry.root / "models" / name / "versions" / str(manifest.version)
    write_atomic(path, manifest.to_bytes())  # after its parameters: a version that is listed can be loaded
    return registry, Version(name, manifest.version)


def _get(service: httpx.Client, path: str) -> bytes:
    """The body of a successful answer."""
    base = str(service.base_url).rstrip("/")
    try:
        response = service.get(path)
    except httpx.TimeoutException:
        raise FetchError(f"{base} does not answer in time; is `tandem serve` well there? Try again") from None
    except httpx.RequestError as error:
        raise FetchError(f"cannot reach {base}: {error}; is `tandem serve` running there?") from None
    if response.status_code != httpx.codes.OK:
        raise _refusal(base, response)
    return response.content


def _refusal(base: str, response: httpx.Response) -> TandemError:
    """The error in an answer that is not a success."""
    kind, problem = response.headers.get("content-type", "nothing"), None
    if kind == "application/problem+json":
        with suppress(ParseError):
            problem = parse_json(response.content, base)
    if not isinstance(problem, dict) or "detail" not in problem:
        return FetchError(
            f"{base} gave {response.status_code} and {one_line(kind, 60)}: is this the URL of a `tandem serve`?"
        )
    detail = f"{base} says: {one_line(str(problem['detail']), 500)}"
    if response.status_code == httpx.codes.UNAUTHORIZED:
        return WrongTokenError(f"{detail}; set {VARIABLE} to it and {URL_VARIABLE} to this URL")
    if problem.get("type") == "urn:tandem:unknown-version":
        return UnknownVersionError(detail)
    if problem.get("type") == "urn:tandem:damaged":
        return DamagedBlobError(detail)
    return FetchError(detail)


def _base_url(url: str) -> str:
    """Check a URL and remove the slash at its end.

    Raises:
        StatusError: not the URL of a service; the message does not quote a password in it.
    """
    try:
        parsed = httpx.URL(url)
    except httpx.InvalidURL:
        raise StatusError("the registry's URL cannot be read; write http://HOST:PORT") from None
    if parsed.userinfo or not parsed.host or parsed.scheme not in ("http", "https"):
        raise StatusError(f"write the registry's URL as http://HOST:PORT; for the service's token there is {VARIABLE}")
    return url.rstrip("/")
