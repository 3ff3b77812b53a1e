"""What `ray job submit --working-dir .` sends along from a checkout: no run, no registry, no secret."""

from pathlib import Path

import pytest
from ray._private.runtime_env.packaging import get_excludes_from_ignore_files

from tests.deploy.files import ROOT

IGNORED = ("runs/cube/metrics.jsonl", "registry/models/a", ".env", "deploy/compose/.env", ".venv/bin/python")


@pytest.fixture(scope="module")
def is_left_out():
    rules = get_excludes_from_ignore_files(ROOT, include_gitignore=True)
    return lambda path: any(rule(Path(ROOT / path)) for rule in rules)


@pytest.mark.parametrize("path", IGNORED)
def test_it_is_left_out(is_left_out, path):
    assert is_left_out(path)


def test_the_code_is_sent_along(is_left_out):
    kept = ("service/registry/registry.py", "service/registry/data", "configs/pretrain/panda_cube.yaml")
    assert not any(map(is_left_out, kept))
    assert not any(is_left_out(path) for path in (ROOT / "service").rglob("*.py"))
