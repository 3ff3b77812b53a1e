"""The OpenAPI document: what every route has in common is written into it here, so that no route can leave it out."""

from __future__ import annotations

from typing import Any

from fastapi import FastAPI
from fastapi.openapi.utils import get_openapi

from service.status.guard import OPEN, PROBES
from service.status.problems import MEDIA_TYPE, Problem

_CONTENT = {MEDIA_TYPE: {"schema": {"$ref": "#/components/schemas/Problem"}}}
_COMMON = {
    "400": "The request is not HTTP as it should be.",
    "401": "A token is needed, or it is the wrong one.",
    "408": "The body did not come in time.",
    "413": "The body is too large.",
    "421": "Asked for another host than localhost.",
    "500": "Something on the service's side is damaged or failed.",
}
_CHANGING = {"403": "This service has no token and so changes nothing."}
_SCHEMES = {
    "bearer": {"type": "http", "scheme": "bearer", "description": "The token the service was started with."},
    "basic": {
        "type": "http",
        "scheme": "basic",
        "description": "The same token as the password, for browsers; GET only.",
    },
}
DESCRIPTION = """
What runs and primitives there are, and how runs go. Errors are `application/problem+json` (RFC 9457).
On a public address everything but `/livez` needs the token; everywhere all that changes something does.
"""


def problems(*texts: tuple[int, str]) -> dict[int | str, dict[str, Any]]:
    """The ``responses=`` of a route: its own errors by status."""
    return {status: {"description": text, "content": _CONTENT} for status, text in texts}


UNKNOWN_RUN = (404, "There is no such run.")
AWAY = (503, "The runs cannot be read at the moment.")
INVALID = (422, "The request does not fit this document.")


def document(app: FastAPI, *, public: bool) -> dict[str, Any]:
    """The document of the app's routes; ``public``: reading needs the token, too."""
    tree = get_openapi(
        title=app.title, version=app.version, summary=app.summary, description=app.description, routes=app.routes
    )
    components = tree.setdefault("components", {})
    components["securitySchemes"] = _SCHEMES
    components.setdefault("schemas", {})["Problem"] = Problem.model_json_schema(
        ref_template="#/components/schemas/{model}"
    )
    components["schemas"] |= components["schemas"]["Problem"].pop("$defs", {})
    for unused in ("HTTPValidationError", "ValidationError"):  # FastAPI's own shape of a 422
        components["schemas"].pop(unused, None)
    for path, methods in tree["paths"].items():
        for method, operation in methods.items():
            reading = method in ("get", "head")
            for parameter in operation.get("parameters", ()):
                parameter["schema"] = _never_null(parameter["schema"])
            operation["security"] = _security(path, reading=reading, public=public)
            for status, text in {**_COMMON, **({} if reading else _CHANGING)}.items():
                operation["responses"].setdefault(status, {"description": text, "content": _CONTENT})
            operation["responses"] = dict(sorted(operation["responses"].items()))
    return tree


def _never_null(schema: dict[str, Any]) -> dict[str, Any]:
    """A parameter can be left out, but there is no null in a URL or a header."""
    options = [option for option in schema.get("anyOf", ()) if option != {"type": "null"}]
    if len(options) != 1:
        return schema
    return {**{key: value for key, value in schema.items() if key != "anyOf"}, **options[0]}


def _security(path: str, *, reading: bool, public: bool) -> list[dict[str, list[str]]]:
    if not reading:
        return [{"bearer": []}]
    if path in OPEN:
        return []
    schemes: list[dict[str, list[str]]] = [{"bearer": []}, {"basic": []}]
    return schemes if public and path not in PROBES else [{}, *schemes]
