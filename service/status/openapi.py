"""What FastAPI's document of the API does not know by itself: errors and security, which routes share."""

from __future__ import annotations

from typing import Any

from fastapi import FastAPI, Security
from fastapi.security import APIKeyCookie, HTTPBearer

from service.registry.token import SESSION_COOKIE
from service.status.problems import MEDIA_TYPE, Problem

DESCRIPTION = """
Runs, their progress, and primitives. Errors are `application/problem+json` (RFC 9457).
On a public address every request but `/livez` needs the token; on any address those that change something need it.
"""
_CONTENT = {MEDIA_TYPE: {"schema": {"$ref": "#/components/schemas/Problem"}}}


def problems(*texts: tuple[int, str]) -> dict[int | str, dict[str, Any]]:
    """The ``responses=`` argument of a route for its own errors: (status, description) each."""
    return {status: {"description": text, "content": _CONTENT} for status, text in texts}


COMMON = problems(
    (400, "The request is malformed HTTP."),
    (401, "A token is needed, or it is the wrong one."),
    (413, "The body is too large."),
    (421, "The host is not localhost."),
    (500, "A file of the service is damaged, or the service failed."),
)
"""Errors of every route."""
UNKNOWN_RUN = (404, "There is no such run.")
UNAVAILABLE = (503, "The runs cannot be read at the moment.")
INVALID = (422, "The request does not match this document.")
READ_ONLY = (403, "This service has no token and so changes nothing.")
SECURITY = [
    Security(HTTPBearer(description="The token the service was started with.", auto_error=False)),
    Security(
        APIKeyCookie(
            name=SESSION_COOKIE, description="Set by POST /v1/session, for browsers; GET only.", auto_error=False
        )
    ),
]
"""Dependencies that only tell how to show the token; ``AuthMiddleware`` asks for it."""


class DocumentedApp(FastAPI):
    """An app whose document has the schema of errors, and parameters that can be left out but are never null."""

    def openapi(self) -> dict[str, Any]:
        """The OpenAPI document."""
        tree = super().openapi()
        problem = Problem.model_json_schema(ref_template="#/components/schemas/{model}")
        tree["components"]["schemas"] |= {"Problem": problem, **problem.pop("$defs")}
        for parameter in (
            each for path in tree["paths"].values() for each in path.get("get", {}).get("parameters", ())
        ):
            schema = parameter["schema"]
            schema |= schema.pop("anyOf", [{}])[0]
        return tree
