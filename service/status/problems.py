"""Errors in the format of RFC 9457: all that is not a success is ``application/problem+json``, without a trace.

FastAPI does not know of them: what its document says of a route's errors is made here, too.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from http import HTTPStatus
from typing import Any

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from pydantic import BaseModel, Field
from starlette.exceptions import HTTPException
from starlette.responses import JSONResponse

from service.base.errors import (
    DamagedBlobError,
    DamagedStoreError,
    FormatVersionError,
    StoreUnavailableError,
    TandemError,
    UnknownRunError,
    UnknownVersionError,
)

MEDIA_TYPE = "application/problem+json"
_BLANK = "about:blank"
_RETRY_AFTER_S = 5


class FieldError(BaseModel):
    """An invalid field of a request."""

    where: str = Field(description="such as query.max_points", examples=["query.max_points"])
    message: str = Field(examples=["Input should be greater than or equal to 2"])


class Problem(BaseModel):
    """An error, after RFC 9457."""

    type: str = Field(
        _BLANK, description="what kind of error: programs branch on it", examples=["urn:tandem:unknown-run"]
    )
    title: str = Field(description="the status in words", examples=["Not Found"])
    status: int = Field(ge=400, le=599, description="the HTTP status", examples=[404])
    detail: str = Field(description="one line for people: what, where, which value, what to do")
    errors: tuple[FieldError, ...] = Field((), description="if the request does not fit the schema")


class ProblemError(Exception):
    """An error that ends a request with a problem.

    ``kind`` is the end of the problem's type, such as ``unknown-run``; None if the HTTP status says it all.
    """

    def __init__(
        self,
        status: int,
        kind: str | None,
        detail: str,
        headers: Mapping[str, str] | None = None,
        errors: Sequence[FieldError] = (),
    ) -> None:
        super().__init__(detail)
        self.problem = Problem(
            type=f"urn:tandem:{kind}" if kind else _BLANK,
            title=HTTPStatus(status).phrase,
            status=status,
            detail=detail,
            errors=tuple(errors),
        )
        retry = {"Retry-After": str(_RETRY_AFTER_S)} if status == HTTPStatus.SERVICE_UNAVAILABLE else {}
        self.headers = {**retry, **(headers or {})}

    def response(self) -> JSONResponse:
        """Make the answer."""
        content = self.problem.model_dump(mode="json", exclude=None if self.problem.errors else {"errors"})
        return JSONResponse(content, self.problem.status, self.headers, MEDIA_TYPE)


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
_KINDS: tuple[tuple[type[TandemError], int, str], ...] = (
    (UnknownRunError, 404, "unknown-run"),
    (UnknownVersionError, 404, "unknown-version"),
    (StoreUnavailableError, 503, "store-unavailable"),
    (DamagedStoreError, 500, "damaged"),
    (DamagedBlobError, 500, "damaged"),
    (FormatVersionError, 500, "other-format"),
    (TandemError, 500, "failed"),
)
"""Status and kind by error; the first match counts."""


def add_handlers(app: FastAPI) -> None:
    """Turn errors of the routes into problems; ``AuthMiddleware`` answers ``ProblemError`` and unexpected ones."""

    @app.exception_handler(TandemError)
    def on_tandem_error(_: Request, error: TandemError) -> JSONResponse:
        status, kind = next((status, kind) for known, status, kind in _KINDS if isinstance(error, known))
        return ProblemError(status, kind, str(error)).response()

    @app.exception_handler(RequestValidationError)
    def on_invalid(_: Request, error: RequestValidationError) -> JSONResponse:
        errors = [_field_error(each) for each in error.errors()[:20]]
        detail = "; ".join(f"{each.where}: {each.message}" for each in errors[:3])
        return ProblemError(422, "invalid-request", f"{detail}; see /openapi.json", errors=errors).response()

    @app.exception_handler(HTTPException)
    def on_http(request: Request, error: HTTPException) -> JSONResponse:
        path = request.url.path[:100]
        details = {
            404: f"there is nothing at {path!r}; /openapi.json lists every route",
            405: f"{path!r} does not take {request.method[:16]!r}; the header Allow lists what it takes",
        }
        detail = details.get(error.status_code, str(error.detail))
        return ProblemError(error.status_code, None, detail, error.headers).response()


def _field_error(error: Mapping[str, Any]) -> FieldError:
    where = ".".join(str(part)[:64] for part in error["loc"])
    given = "" if error["type"] in ("missing", "json_invalid") else f", got {str(error['input'])[:64]!r}"
    return FieldError(where=where, message=f"{error['msg']}{given}")
