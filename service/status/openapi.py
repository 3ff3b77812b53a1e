"""The OpenAPI document; errors and security, which all routes share, are added here so that no route can omit them."""

from __future__ import annotations

from typing import Any

from service.registry.token import SESSION_COOKIE
from service.status.auth import OPEN, PROBES, SESSION
from service.status.problems import MEDIA_TYPE, Problem

_CONTENT = {MEDIA_TYPE: {"schema": {"$ref": "#/components/schemas/Problem"}}}
_COMMON = {
    "400": "The request is malformed HTTP.",
    "401": "A token is needed, or it is the wrong one.",
    "413": "The body is too large.",
    "421": "The host is not localhost.",
    "500": "A file of the service is damaged, or the service failed.",
}
_SCHEMES = {
    "bearer": {"type": "http", "scheme": "bearer", "description": "The token the service was started with."},
    "session": {
        "type": "apiKey",
        "in": "cookie",
        "name": SESSION_COOKIE,
        "description": "Set by POST /v1/session, for browsers; GET only.",
    },
}
DESCRIPTION = """
Runs, their progress, and primitives. Errors are `application/problem+json` (RFC 9457).
On a public address every request but `/livez` needs the token; on any address those that change something need it.
"""


def problems(*texts: tuple[int, str]) -> dict[int | str, dict[str, Any]]:
    """The ``responses=`` argument of a route for its own errors: (status, description) each."""
    return {status: {"description": text, "content": _CONTENT} for status, text in texts}


UNKNOWN_RUN = (404, "There is no such run.")
UNAVAILABLE = (503, "The runs cannot be read at the moment.")
INVALID = (422, "The request does not match this document.")
READ_ONLY = (403, "This service has no token and so changes nothing.")


def complete(tree: dict[str, Any], *, public: bool) -> None:
    """Add what all routes share to FastAPI's document; if ``public``, reading needs the token, too."""
    tree["components"]["securitySchemes"] = _SCHEMES
    problem = Problem.model_json_schema(ref_template="#/components/schemas/{model}")
    tree["components"]["schemas"] |= {"Problem": problem, **problem.pop("$defs")}
    for path, methods in tree["paths"].items():
        for method, operation in methods.items():
            reading = method in ("get", "head")
            for parameter in operation.get("parameters", ()):
                schema = parameter["schema"]  # one that can be left out is X or null; a URL cannot hold null
                schema |= schema.pop("anyOf", [{}])[0]
            operation["security"] = _security(path, reading=reading, public=public)
            for status, text in _COMMON.items():
                operation["responses"].setdefault(status, {"description": text, "content": _CONTENT})
            operation["responses"] = dict(sorted(operation["responses"].items()))


def _security(path: str, *, reading: bool, public: bool) -> list[dict[str, list[str]]]:
    if path in OPEN or path == SESSION:
        return []
    if not reading:
        return [{"bearer": []}]
    schemes: list[dict[str, list[str]]] = [{"bearer": []}, {"session": []}]
    return schemes if public and path not in PROBES else [{}, *schemes]
