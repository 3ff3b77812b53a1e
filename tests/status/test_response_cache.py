"""The response cache, in front of an application that counts its requests."""

import asyncio

import pytest

from service.status.response_cache import AGE_S, MAX_ANSWERS, MAX_BYTES, ResponseCache

JSON = b"application/json"


class Counting:
    """An ASGI application whose body is the number of its requests."""

    def __init__(self, status=200, media_type=JSON, pieces=1, num_bytes=0):
        self.status, self.media_type, self.pieces, self.num_bytes, self.asked = status, media_type, pieces, num_bytes, 0

    async def __call__(self, scope, receive, send):
        self.asked += 1
        scope["route"] = f"route of {scope['path']}"
        headers = [(b"content-type", self.media_type)]
        await send({"type": "http.response.start", "status": self.status, "headers": headers})
        for piece in range(self.pieces):
            body = str(self.asked).encode().ljust(self.num_bytes)
            await send({"type": "http.response.body", "body": body, "more_body": piece + 1 < self.pieces})


class Asking:
    """A client behind a ``ResponseCache``, with its own clock."""

    def __init__(self, app):
        self.app, self.now_s = app, 100.0
        self._cache = ResponseCache(app, clock=lambda: self.now_s)

    def __call__(self, path="/v1/runs", *, method="GET", query=b"", headers=()):
        scope = {"type": "http", "method": method, "path": path, "query_string": query, "headers": list(headers)}
        sent = []

        async def send(message):
            message["headers" if "headers" in message else "seen"] = None  # whoever is before it may write into it
            sent.append(message)

        asyncio.run(self._cache(scope, None, send))
        assert scope["route"] == f"route of {path}"
        assert sent[0]["status"] == self.app.status
        return int(sent[1]["body"])


def test_an_answer_is_cached_for_a_moment():
    ask = Asking(Counting())
    assert ask() == 1
    ask.now_s += 0.9 * AGE_S
    assert ask() == 1
    ask.now_s += 0.2 * AGE_S
    assert ask() == 2
    assert ask.app.asked == 2


@pytest.mark.parametrize(
    "other",
    [
        {"path": "/v1/runs/a"},
        {"query": b"limit=1"},
        {"headers": [(b"accept", b"text/plain")]},
    ],
)
def test_another_request_has_its_own_answer(other):
    ask = Asking(Counting())
    assert [ask(), ask(**other), ask(), ask(**other)] == [1, 2, 1, 2]


@pytest.mark.parametrize("method", ["POST", "PUT", "DELETE"])
def test_a_change_empties_the_cache(method):
    ask = Asking(Counting())
    assert [ask(), ask(), ask("/v1/runs/a/stop", method=method), ask()] == [1, 1, 2, 3]


@pytest.mark.parametrize("path", ["/readyz", "/healthz", "/livez", "/", "/page/main.js"])
def test_health_and_the_page_are_not_cached(path):
    ask = Asking(Counting())
    assert [ask(path), ask(path)] == [1, 2]


@pytest.mark.parametrize("header", [b"range", b"if-none-match"])
def test_conditional_and_range_requests_are_not_cached(header):
    ask = Asking(Counting())
    assert [ask(headers=[(header, b"x")]), ask(headers=[(header, b"x")])] == [1, 2]


@pytest.mark.parametrize(
    "app",
    [
        Counting(status=404),
        Counting(status=206),
        Counting(media_type=b"text/event-stream"),
        Counting(media_type=b"video/mp4"),
        Counting(pieces=2),
        Counting(num_bytes=MAX_BYTES + 1),
    ],
)
def test_answers_that_are_not_cached(app):
    ask = Asking(app)
    assert [ask(), ask()] == [1, 2]


def test_a_long_body_is_cached_up_to_the_limit():
    ask = Asking(Counting(num_bytes=MAX_BYTES))
    assert [ask(), ask()] == [1, 1]


def test_memory_is_bounded():
    ask = Asking(Counting())
    for number in range(2 * MAX_ANSWERS + 1):
        ask(query=str(number).encode())
        assert len(ask._cache._answers) <= MAX_ANSWERS
    assert ask(query=b"0") == 2 * MAX_ANSWERS + 2
