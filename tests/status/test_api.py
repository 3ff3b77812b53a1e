"""The answer of each route."""

import json
from datetime import UTC, datetime, timedelta

import httpx
import numpy as np
import pytest

from service.base.errors import StorageError
from service.registry.bundled import BUNDLED
from service.registry.manifest import parse_manifest
from service.registry.registry import Registry
from service.status.api_primitives import Shelf
from service.status.server import StatusServer
from service.store.disk_reader import DiskReader
from service.store.models import GoalGrid, RunStatus
from tests.status.conftest import serve
from tests.status.runs import BEARER, CLIENT, TOKEN, grid, publish, record, write_status


def test_health(client):
    assert client.get("/livez").json() == {"status": "alive"}
    assert client.get("/readyz").json() == {"status": "ready"}


def test_runs_newest_start_first(client):
    answer = client.get("/v1/runs").json()
    assert [run["run_id"] for run in answer["runs"]] == ["cube", "old"]
    assert answer["num_runs"] == 2


def test_the_limit_hides_no_active_run(tmp_path):
    write_status(tmp_path / "runs", "cube")
    write_status(tmp_path / "runs", "newer", state="finished", started=datetime.now(UTC) + timedelta(hours=1))
    with serve(tmp_path) as server, httpx.Client(base_url=server.url, headers=BEARER, **CLIENT) as client:
        answer = client.get("/v1/runs?limit=1").json()
    assert [run["run_id"] for run in answer["runs"]] == ["cube"]


@pytest.mark.parametrize(
    ("query", "ids", "num_runs"),
    [("active=true", ["cube"], 1), ("active=false", ["old"], 1), ("limit=1", ["cube"], 2)],
)
def test_active_and_ended_runs(client, query, ids, num_runs):
    answer = client.get(f"/v1/runs?{query}").json()
    assert ([run["run_id"] for run in answer["runs"]], answer["num_runs"]) == (ids, num_runs)


def test_a_run(client, home):
    answer = RunStatus.model_validate_json(client.get("/v1/runs/cube").content)
    assert answer == RunStatus.model_validate_json((home / "runs" / "cube" / "status.json").read_bytes())


def test_metrics_in_columns(client):
    answer = client.get("/v1/runs/old/metrics", params={"names": ["bob/success_rate", "no/such"]}).json()
    assert answer == {
        "run_id": "old",
        "last_iteration": 3,
        "num_iterations": 3,
        "iteration": [1, 2, 3],
        "env_steps": [1000, 2000, 3000],
        "metrics": {"bob/success_rate": [0.125, 0.25, 0.375]},
        "names": sorted(set(record(1)) - {"iteration", "env_steps"}),
    }


def test_all_metrics_where_none_is_named(client):
    answer = client.get("/v1/runs/old/metrics?after_iteration=1&max_points=1").json()
    assert answer["metrics"].keys() == set(answer["names"])
    assert (answer["iteration"], answer["num_iterations"]) == ([3], 2)
    assert answer["metrics"]["bob/success_rate"] == [(0.25 + 0.375) / 2]


def test_goals(client):
    assert GoalGrid.model_validate_json(client.get("/v1/runs/cube/goals").content) == grid()


@pytest.mark.parametrize(("path", "kind"), [("old/goals", "no-goals-yet"), ("cube/video", "no-such-file")])
def test_what_a_run_does_not_have(client, path, kind):
    answer = client.get(f"/v1/runs/{path}")
    assert (answer.status_code, answer.json()["type"]) == (404, f"urn:tandem:{kind}")


def test_files(client):
    files = client.get("/v1/runs/old/files").json()["files"]
    assert [(file["name"], file["num_bytes"]) for file in files] == [("rounds.mp4", 10240), ("curves.png", 12)]
    for file in files:
        answer = client.get(file["url"])
        assert (answer.headers["content-type"], len(answer.content)) == (file["media_type"], file["num_bytes"])


@pytest.mark.parametrize("name", ["status.json", "metrics.jsonl", "..%2Fcube%2Fgoals.json", "%2Fetc%2Fpasswd"])
def test_nothing_else_leaves_a_run_directory(client, name):
    answer = client.get(f"/v1/runs/old/files/{name}")
    assert answer.status_code == 404
    assert "application/problem+json" in answer.headers["content-type"]


def test_stop(client, home):
    write_status(home / "runs", "stoppable")
    answer = client.post("/v1/runs/stoppable/stop")
    assert (answer.status_code, answer.json()["stopping"]) == (202, True)
    assert (home / "runs" / "stoppable" / "stop").exists()


def test_a_run_that_has_ended_stays_as_it_is(client, home):
    answer = client.post("/v1/runs/old/stop")
    assert (answer.status_code, answer.json()["state"]) == (202, "finished")
    assert not (home / "runs" / "old" / "stop").exists()


def test_primitives(client):
    answer = client.get("/v1/primitives").json()
    *bundled, tiny = answer["primitives"]
    aliases = {"champion": 1, "latest": 2}
    assert tiny == {"name": "tiny", "num_versions": 2, "newest": 2, "aliases": aliases, "origins": ["registry"]}
    assert [(each["name"], each["origins"]) for each in bundled] == [
        ("panda-cube", ["bundled"]),
        ("panda-cube-robust", ["bundled"]),
        ("panda-two-cubes", ["bundled"]),
    ]


def test_what_comes_with_tandem_is_beside_the_users_own(tmp_path):
    newest = Registry(BUNDLED).versions("panda-cube")[-1]
    registry = Registry(tmp_path / "registry")
    own = publish(registry, "panda-cube")
    (tmp_path / "runs").mkdir()
    with serve(tmp_path) as server, httpx.Client(base_url=server.url, headers=BEARER, **CLIENT) as client:
        answer = client.get("/v1/primitives/panda-cube").json()
        manifest = client.get(f"/v1/primitives/panda-cube/versions/{newest.number}").json()
        blob = client.get(f"/v1/blobs/sha256/{manifest['blob_sha256']}")
    assert answer["origins"] == ["registry", "bundled"]
    assert [(each["version"], each["origin"], each["directory"]) for each in answer["versions"]] == [
        (newest.number, "bundled", str(BUNDLED)),
        (own.number, "registry", str(registry.root)),
    ]
    assert answer["aliases"]["latest"] == own.number  # as for who loads panda-cube: the user's own counts
    assert answer["versions"][0]["aliases"] == ["champion"]
    assert manifest == json.loads(Registry(BUNDLED).manifest(str(newest)).to_bytes())
    assert len(blob.content) == manifest["blob_bytes"]


def test_the_lineage_of_an_orchestrator(tmp_path):
    registry = Registry(tmp_path / "registry")
    fields = {"normalisation": {}, "config": {}, "metrics": {}}
    spaces = {"kind": "orchestrator", "primitives": "panda-cube@6"}
    registry.publish("push", {"gate.weight": np.zeros(2, np.float32)}, spaces=spaces, **fields)
    (version,) = Shelf(registry).versions("push", limit=2)
    assert (version.kind, version.primitives) == ("orchestrator", "panda-cube@6")


def test_versions_of_a_name(client, home):
    answer = client.get("/v1/primitives/tiny").json()
    assert [(each["version"], each["aliases"]) for each in answer["versions"]] == [(2, ["latest"]), (1, ["champion"])]
    manifest = Registry(home / "registry").manifest("tiny@1")
    first = answer["versions"][1]
    assert (first["blob_sha256"], first["metrics"], first["problem"]) == (manifest.blob_sha256, manifest.metrics, None)
    assert len(client.get("/v1/primitives/tiny?limit=1").json()["versions"]) == 1


def test_a_name_of_another_user_does_not_hide_the_bundled_one(registry, monkeypatch):
    for verb in ("versions", "aliases"):
        monkeypatch.setattr(Registry, verb, refusing(getattr(Registry, verb), registry.root))
    summary = Shelf(registry).summary("panda-cube")
    assert summary.origins == ("bundled",)
    assert "champion" in summary.aliases
    assert len(Shelf(registry).versions("panda-cube", limit=1)) == 1


def refusing(asked, root):
    """As a directory of another user does; root may read everything."""

    def refused(registry, name):
        if registry.root == root:
            raise PermissionError
        return asked(registry, name)

    return refused


def test_a_damaged_manifest_does_not_hide_the_others(client, home):
    registry = Registry(home / "registry")
    publish(registry, "half")
    publish(registry, "half")
    (home / "registry" / "models" / "half" / "versions" / "1").write_text("{}")
    newest, damaged = client.get("/v1/primitives/half").json()["versions"]
    assert newest["problem"] is None
    assert "format version" in damaged["problem"]
    answer = client.get("/v1/primitives/half/versions/1")
    assert (answer.status_code, answer.json()["type"]) == (500, "urn:tandem:other-format")


def test_a_manifest_that_may_not_be_read_does_not_hide_the_others(client, monkeypatch):
    manifest = Registry.manifest

    def refused(registry, reference):
        if reference == "tiny@1":
            raise StorageError("cannot read tiny@1: Permission denied")
        return manifest(registry, reference)

    monkeypatch.setattr(Registry, "manifest", refused)
    newest, other = client.get("/v1/primitives/tiny").json()["versions"]
    assert (newest["problem"], other["problem"]) == (None, "cannot read tiny@1: Permission denied")


@pytest.mark.parametrize(("version", "number"), [("1", 1), ("champion", 1), ("latest", 2)])
def test_a_manifest_as_it_was_published(client, home, version, number):
    answer = client.get(f"/v1/primitives/tiny/versions/{version}")
    path = home / "registry" / "models" / "tiny" / "versions" / str(number)
    assert answer.content == path.read_bytes()
    assert parse_manifest(answer.content, path).version == number


def test_aliases_move_forward_and_back(client, home):
    registry = Registry(home / "registry")
    publish(registry, "moving")
    publish(registry, "moving")
    for number in (2, 1):
        answer = client.put("/v1/primitives/moving/aliases/best", json={"version": number})
        assert (answer.status_code, answer.json()) == (200, {"name": "moving", "alias": "best", "version": number})
        assert registry.aliases("moving")["best"] == number


@pytest.mark.parametrize("version", [True, "1", 1.0, None])
def test_an_alias_is_moved_to_a_number_only(client, version):
    answer = client.put("/v1/primitives/tiny/aliases/best", json={"version": version})
    assert (answer.status_code, answer.json()["type"]) == (422, "urn:tandem:invalid-request")


def test_the_bundled_registry_is_read_only(tmp_path):
    with StatusServer(DiskReader(tmp_path), Registry(BUNDLED), token=TOKEN, port=0) as server:
        url = f"{server.url}/v1/primitives/panda-cube/aliases/mine"
        answer = httpx.put(url, json={"version": 2}, headers=BEARER, **CLIENT)
    assert (answer.status_code, answer.json()["type"]) == (409, "urn:tandem:read-only")


def test_the_page_and_its_files(client):
    page = client.get("/")
    assert page.headers["content-type"].startswith("text/html")
    assert client.get("/page/index.html").content == page.content


def test_every_answer_is_safe_in_a_browser(client):
    for path in ("/", "/livez", "/v1/runs", "/v1/nope", "/page/index.html", "/metrics"):
        headers = client.get(path, headers={"Origin": "https://elsewhere.example"}).headers
        assert headers["x-content-type-options"] == "nosniff"
        assert headers["referrer-policy"] == "no-referrer"
        assert "default-src 'self'" in headers["content-security-policy"]
        assert [name for name in headers if name.startswith("access-control")] == []
        assert "server" not in headers


def test_head_is_get_without_a_body(client):
    for path in ("/v1/runs", "/v1/runs/old/video", "/livez"):
        got, headed = client.get(path), client.head(path)
        assert (headed.status_code, headed.content) == (200, b"")
        assert headed.headers["content-length"] == got.headers["content-length"]


def test_openapi_lists_every_route(client, server):
    paths = client.get("/openapi.json").json()["paths"]
    assert set(paths) == {
        "/livez", "/readyz", "/metrics", "/v1/runs", "/v1/runs/{run_id}", "/v1/runs/{run_id}/metrics",
        "/v1/runs/{run_id}/metrics/stream", "/v1/runs/{run_id}/goals", "/v1/runs/{run_id}/stop",
        "/v1/runs/{run_id}/files", "/v1/runs/{run_id}/files/{file}", "/v1/runs/{run_id}/video", "/v1/primitives",
        "/v1/primitives/{name}", "/v1/primitives/{name}/versions/{version}", "/v1/blobs/sha256/{digest}",
        "/v1/primitives/{name}/aliases/{alias}", "/v1/series", "/v1/series.csv", "/v1/session",
        "/v1/runs/{run_id}/setup", "/v1/runs/{run_id}/log", "/v1/runs/{run_id}/goals/history", "/v1/downstream",
    }  # fmt: skip
    assert json.loads(json.dumps(server.app.openapi()))["paths"] == paths
    for path, methods in paths.items():
        for method, operation in methods.items():
            assert operation["summary"], (method, path)
            assert {"401", "500"} <= operation["responses"].keys()
