"""The token never appears in a log, a page or an answer."""

import logging

import httpx

from tests.status.conftest import serve
from tests.status.runs import CLIENT, TOKEN, WRONG
from tests.status.test_auth import BODIES, routes


def test_no_secret_leaves(home, caplog):
    caplog.set_level(logging.DEBUG)
    logging.getLogger("httpx").setLevel(logging.WARNING)  # the client's log, which is not the service's
    logging.getLogger("httpcore").setLevel(logging.WARNING)
    answers = []
    with serve(home, host="0.0.0.0") as server, httpx.Client(base_url=server.url, **CLIENT) as client:
        for authorization in (f"Bearer {TOKEN}", f"Bearer {WRONG}", f"Token {TOKEN}"):
            for method, path in routes(server):
                headers = {"Authorization": authorization}
                answers.append(client.request(method, path, headers=headers, json=BODIES.get(method)))
        answers.append(client.get("/metrics", headers={"Authorization": f"Bearer {TOKEN}"}))
    assert {answer.status_code for answer in answers} >= {200, 401, 404}
    told = [answer.text + str(answer.headers) for answer in answers] + [caplog.text]
    assert [secret for secret in (TOKEN, WRONG) for text in told if secret in text] == []
