"""The OpenAPI document is correct: schemathesis sends a real service valid and invalid requests."""

import subprocess
import sys

from service.registry.registry import Registry
from tests.status.conftest import serve
from tests.status.runs import TOKEN, VIDEO, append, grid, publish, record, write_status

SETTINGS = """
[parameters]
run_id = "cube"
name = "panda-cube"
version = "champion"
file = "rounds.mp4"
digest = "{digest}"

# HTTP lets anybody add headers; schemathesis doubts that only where a route, as this one, declares a header itself
[[operations]]
include-name = "GET /v1/runs/{{run_id}}/metrics/stream"
checks.negative_data_rejection.enabled = false
"""


def test_schemathesis_finds_nothing(tmp_path):
    # the run has ended, so that its stream ends, too; the address is public, so that every route has a token to refuse
    write_status(tmp_path / "runs", "cube", state="finished")
    append(tmp_path / "runs", "cube", record(1), record(2))
    (tmp_path / "runs" / "cube" / "goals.json").write_text(grid().model_dump_json())
    (tmp_path / "runs" / "cube" / "rounds.mp4").write_bytes(VIDEO)
    registry = Registry(tmp_path / "registry")
    publish(registry, "panda-cube")
    registry.set_alias("panda-cube", "champion", 1)
    digest = registry.manifest("panda-cube").blob_sha256
    (tmp_path / "schemathesis.toml").write_text(SETTINGS.format(digest=digest))
    with serve(tmp_path, host="0.0.0.0") as server:
        command = (
            f"--config-file schemathesis.toml run {server.url}/openapi.json --phases examples,coverage "
            "--max-examples 2 --generation-deterministic --no-color"
        )
        result = subprocess.run(
            [sys.executable, "-m", "schemathesis.cli", *command.split(), "--header", f"Authorization: Bearer {TOKEN}"],
            cwd=tmp_path,
            capture_output=True,
            text=True,
            timeout=600,
            check=False,
        )
    assert result.returncode == 0, result.stdout + result.stderr
    assert "24 selected / 24 total" in result.stdout
    assert "Missing test data" not in result.stdout
