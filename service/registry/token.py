"""The bearer token: reading it, and checking a request for it."""

from __future__ import annotations

import hmac
import os
from pathlib import Path
from typing import Literal

from service.base.errors import StatusError
from service.base.files import read_regular

VARIABLE = "TANDEM_TOKEN"
SESSION_COOKIE = "tandem_session"
MIN_CHARACTERS = 16
MAX_BYTES = 4096
"""Of its file."""
_MAKE = "make one with: openssl rand -hex 32"


def read_token(file: Path | None = None) -> str | None:
    """Read the token from a file or, without a file, from ``TANDEM_TOKEN``; None if that is not set or empty.

    Raises:
        StatusError: the file cannot be read, or its text is not a token; the message does not quote it.
    """
    if file is None:
        text, source = os.environ.get(VARIABLE, ""), VARIABLE
        return check_token(text.strip(), source) if text.strip() else None
    try:
        text = read_regular(file, MAX_BYTES, follow=True).decode("ascii", errors="replace")
    except OSError as error:
        raise StatusError(f"--token-file {file}: {error.strerror}; name a file that holds one token") from None
    return check_token(text.strip(), f"--token-file {file}")


def check_token(token: str, source: str) -> str:
    """Check and return a token that ``source`` gave.

    Raises:
        StatusError: it is too short, or cannot be sent in a header.
    """
    if len(token) < MIN_CHARACTERS:
        raise StatusError(f"{source} has {len(token)} characters, {MIN_CHARACTERS} are the least; {_MAKE}")
    if not (token.isascii() and token.isprintable() and " " not in token):
        raise StatusError(f"{source} has other characters than visible ASCII; {_MAKE}")
    return token


def check_authorization(authorization: str | None, token: str) -> Literal["missing", "wrong", "right"]:
    """Compare an ``Authorization`` header with the token."""
    if authorization is None:
        return "missing"
    scheme, _, rest = authorization.strip().partition(" ")
    # as bytes: compare_digest raises for text that is not ASCII, which is only a wrong token here
    is_same = hmac.compare_digest(rest.strip().encode(), token.encode())
    return "right" if is_same and scheme.lower() == "bearer" else "wrong"


def session_secret(token: str) -> str:
    """What a browser keeps in place of the token: it cannot be turned back, and another token makes it worthless."""
    return hmac.new(token.encode(), b"tandem session", "sha256").hexdigest()


def check_session(cookie: str | None, token: str) -> bool:
    """Whether a browser's cookie is of a session of this token."""
    return cookie is not None and hmac.compare_digest(cookie.encode(), session_secret(token).encode())
