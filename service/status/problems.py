"""Errors as RFC 9457 has them: ``application/problem+json`` for all that is not a success, and never a stack trace."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from http import HTTPStatus
from typing import Any

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from pydantic import BaseModel, ConfigDict, Field
from starlette.exceptions import HTTPException
from starlette.responses import JSONResponse

from service.errors import TandemError
from service.io.errors import FormatVersionError
from service.registry.errors import DamagedBlobError, UnknownVersionError
from service.store.errors import DamagedStoreError, StoreError, StoreUnavailableError, UnknownRunError

MEDIA_TYPE = "application/problem+json"
_BLANK = "about:blank"
_RETRY_AFTER_S = 5


class FieldError(BaseModel):
    """What is wrong with one part of a request."""

    model_config = ConfigDict(frozen=True)
    where: str = Field(description="such as query.max_points", examples=["query.max_points"])
    message: str = Field(examples=["Input should be greater than or equal to 2"])


class Problem(BaseModel):
    """An error, after RFC 9457."""

    model_config = ConfigDict(frozen=True)
    type: str = Field(
        _BLANK, description="what kind of error: programs branch on it", examples=["urn:tandem:unknown-run"]
    )
    title: str = Field(description="the status in words", examples=["Not Found"])
    status: int = Field(ge=400, le=599, description="the HTTP status", examples=[404])
    detail: str = Field(description="one line for people: what, where, which value, what to do")
    errors: tuple[FieldError, ...] = Field((), description="of a request that does not fit the schema")


class ProblemError(Exception):
    """Ends a request with a problem; ``kind`` is the end of its type, such as ``unknown-run``."""

    def __init__(self, status: int, kind: str, detail: str, headers: Mapping[str, str] | None = None) -> None:
        super().__init__(detail)
        self.status, self.kind, self.detail, self.headers = status, kind, detail, dict(headers or {})

    def response(self) -> JSONResponse:
        """As an answer."""
        return problem_response(self.status, self.kind, self.detail, self.headers)


def problem_response(
    status: int,
    kind: str | None,
    detail: str,
    headers: Mapping[str, str] | None = None,
    errors: Sequence[FieldError] = (),
) -> JSONResponse:
    """An answer that is a problem; a ``kind`` of None says no more than the status does."""
    problem = Problem(
        type=f"urn:tandem:{kind}" if kind else _BLANK,
        title=HTTPStatus(status).phrase,
        status=status,
        detail=detail,
        errors=tuple(errors),
    )
    retry = {"Retry-After": str(_RETRY_AFTER_S)} if status == HTTPStatus.SERVICE_UNAVAILABLE else {}
    content = problem.model_dump(mode="json", exclude={"errors"} if not errors else None)
    return JSONResponse(content, status, {**retry, **(headers or {})}, MEDIA_TYPE)


_KINDS: tuple[tuple[type[TandemError], int, str], ...] = (
    (UnknownRunError, 404, "unknown-run"),
    (UnknownVersionError, 404, "unknown-version"),
    (StoreUnavailableError, 503, "store-unavailable"),
    (DamagedStoreError, 500, "damaged"),
    (DamagedBlobError, 500, "damaged"),
    (FormatVersionError, 500, "other-format"),
    (StoreError, 409, "not-possible"),
    (TandemError, 500, "failed"),
)
"""Status and kind by error, the first that fits."""


def problem_of(error: TandemError) -> ProblemError:
    """The problem that tells of an error of ours, whose message is written for users."""
    status, kind = next((status, kind) for known, status, kind in _KINDS if isinstance(error, known))
    return ProblemError(status, kind, str(error))


def add_handlers(app: FastAPI) -> None:
    """Make every error of the app's routes a problem; unforeseen ones are the guard's."""
    app.add_exception_handler(ProblemError, _on_problem)
    app.add_exception_handler(TandemError, _on_tandem_error)
    app.add_exception_handler(RequestValidationError, _on_invalid)
    app.add_exception_handler(HTTPException, _on_http)


def _on_problem(_: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, ProblemError)
    return error.response()


def _on_tandem_error(_: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, TandemError)
    return problem_of(error).response()


def _on_invalid(_: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, RequestValidationError)
    errors = [_field_error(each) for each in error.errors()[:20]]
    detail = "; ".join(f"{each.where}: {each.message}" for each in errors[:3])
    return problem_response(422, "invalid-request", f"{detail}; see /openapi.json", errors=errors)


def _field_error(error: Mapping[str, Any]) -> FieldError:
    where = ".".join(str(part)[:64] for part in error["loc"])
    given = "" if error["type"] in ("missing", "json_invalid") else f", got {str(error['input'])[:64]!r}"
    return FieldError(where=where, message=f"{error['msg']}{given}")


def _on_http(request: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, HTTPException)
    path = request.url.path[:100]
    details = {
        404: f"there is nothing at {path!r}; /openapi.json lists every route",
        405: f"{path!r} does not take {request.method[:16]!r}; the header Allow lists what it takes",
    }
    headers = dict(error.headers or {})
    if error.status_code == HTTPStatus.METHOD_NOT_ALLOWED:
        headers.setdefault("Allow", "GET, HEAD")  # of static files, the only ones that leave it out
    return problem_response(error.status_code, None, details.get(error.status_code, str(error.detail)), headers)
