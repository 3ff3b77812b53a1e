"""Downstream trainings beside runs of pre-training: the list, one of them, and the table of tasks."""

import os
import shlex

import httpx
import pytest

from service.io.lock import DirectoryLock
from service.registry.registry import Registry
from service.status.files import RunDirectories
from service.status.task_table import task_table
from service.store.disk_reader import DiskReader
from tests.status.conftest import serve
from tests.status.runs import BEARER, CLIENT, VIDEO, publish, write_runs, write_trial

OTHERS = {"primitives": {"name": "other@2", "digest": "1" * 64, "env_steps": None}}


@pytest.fixture
def root(tmp_path):
    write_runs(tmp_path / "runs")
    return tmp_path / "runs"


@pytest.fixture
def ask(root):
    publish(Registry(root.parent / "registry"))
    with serve(root.parent) as server, httpx.Client(base_url=server.url, headers=BEARER, **CLIENT) as client:
        yield lambda path, **query: client.get(f"/v1/{path}", params=query).raise_for_status().json()


def table(root):
    return task_table(RunDirectories(root).trials())


def shown(found):
    """Rows as (method, primitives, {task: success}), to three digits."""
    return [
        (row.method, row.primitives, {cell.task: cell.success and round(cell.success, 3) for cell in row.cells})
        for row in found.rows
    ]


# --- the table ------------------------------------------------------------------------------------------------------


def test_means_and_intervals(root):
    for seed, success in enumerate((0.80, 0.82, 0.84)):
        write_trial(root, f"push-{seed}", "push", "ours", seed, success)
    write_trial(root, "larger", "larger", "ours", 0, 0.5)
    (row,) = table(root).rows
    larger, push = row.cells  # in the order of the paper
    assert (row.method, row.title, row.primitives) == ("ours", "ours", "tiny@1")
    assert (push.success, push.num_seeds, push.run_ids) == (pytest.approx(0.82), 3, ("push-0", "push-1", "push-2"))
    half = 4.303 * 0.02 / 3**0.5  # Student's t for two degrees of freedom, times the standard error
    assert (push.low, push.high) == (pytest.approx(0.82 - half), pytest.approx(0.82 + half))
    # Wilson of 150 of 300: 1.96 * sqrt(1/4 / 300 + 1.96^2 / (4 * 300^2)) / (1 + 1.96^2 / 300)
    assert (larger.success, larger.num_seeds) == (0.5, 1)
    assert (larger.low, larger.high) == (pytest.approx(0.44378, abs=1e-4), pytest.approx(0.55622, abs=1e-4))


def test_only_seeds_of_the_same_are_averaged(root):
    write_trial(root, "a", "push", "ours", 0, 0.2)
    write_trial(root, "b", "push", "ours", 1, 0.4, num_env_steps=4000)
    write_trial(root, "c", "wall", "ours", 0, 0.6, num_env_steps=4000)
    write_trial(root, "d", "push", "ours", 0, 0.8, made=OTHERS)
    write_trial(root, "e", "push", "ours", 0, 0.9, made={"world": {"object_mass_kg": 0.3}})
    found = table(root)
    assert shown(found) == [
        ("ours", "other@2", {"push": 0.8}),
        ("ours", "tiny@1", {"push": 0.4, "wall": 0.6}),
        ("ours", "tiny@1", {"push": 0.2}),
        ("ours", "tiny@1", {"push": 0.9}),
    ]
    assert [cell.differs for cell in found.rows[1].cells] == [{"num_env_steps": 4000, "world.object_mass_kg": 0.1}] * 2
    assert found.rows[3].cells[0].differs == {"num_env_steps": 2000, "world.object_mass_kg": 0.3}
    assert found.rows[0].cells[0].differs == {}


def test_tasks_with_different_budgets_share_a_row(root):
    write_trial(root, "a", "push", "ours", 0, 0.2, num_env_steps=3000)
    write_trial(root, "b", "wall", "ours", 0, 0.4)
    write_trial(root, "idle", "wall", "idle", 0, 0.0, made={"primitives": None})
    assert shown(table(root)) == [("ours", "tiny@1", {"push": 0.2, "wall": 0.4}), ("idle", None, {"wall": 0.0})]


def test_of_a_seed_that_was_run_twice_the_newer_counts(root):
    older = write_trial(root, "z", "push", "ours", 0, 0.2)
    write_trial(root, "b", "push", "ours", 0, 0.4)
    write_trial(root / "table", "c", "push", "ours", 1, None)
    os.utime(older / "result.json", (1, 1))
    (cell,) = table(root).rows[0].cells
    assert (cell.success, cell.run_ids, cell.unfinished) == (0.4, ("b",), ("table-c",))


def test_what_is_damaged_or_unknown_hides_nothing_else(root):
    write_trial(root, "good", "push", "ours", 0, 0.4)
    write_trial(root, "future", "juggle", "telepathy", 0, 0.6, task_version=7)
    for name, file, text in (
        ("no-json", "cell.json", "{"),
        ("no-trial", "cell.json", '{"format_version": 1, "cell": 7}'),
        ("no-result", "result.json", '{"format_version": 1, "evaluation": {}}'),
        ("no-number", "result.json", '{"format_version": 1, "evaluation": NaN}'),
    ):
        (write_trial(root, name, "push", "ours", 9, 0.1) / file).write_text(text)
    found = table(root)
    assert shown(found) == [("ours", "tiny@1", {"push": 0.4}), ("telepathy", "tiny@1", {"juggle": 0.6})]
    assert [task.version for task in found.tasks] == [1, 7]
    damaged = ("no-json/cell.json", "no-number/result.json", "no-result/result.json", "no-trial/cell.json")
    assert sorted(text.split(":")[0].split(" ")[0] for text in found.problems) == [f"{root}/{name}" for name in damaged]
    runs = {run.run_id: run for run in DiskReader(root).runs()}
    assert runs["no-json"].trial is None
    assert all(len(runs[name].warnings) == 1 for name in ("no-json", "no-trial", "no-result", "no-number"))


# --- runs, over HTTP ------------------------------------------------------------------------------------------------


def test_trainings_are_runs(root, ask):
    write_trial(root / "downstream", "push-ours-3", "push", "ours", 3, 0.75)
    (root / "downstream" / "push-ours-3" / "episodes.mp4").write_bytes(VIDEO)
    (root / "downstream" / "notes").mkdir()
    (root / "here").symlink_to(root)
    (root / "linked").symlink_to(root / "downstream")
    assert ask("runs")["num_runs"] == 3
    assert {run["run_id"] for run in ask("runs", downstream=False)["runs"]} == {"cube", "old"}
    found = ask("runs", downstream=True, sparkline=["bob/success_rate", "rollout/success_last"])
    (run,) = found["runs"]
    assert (run["run_id"], run["name"], run["state"]) == ("downstream-push-ours-3", "push-ours-3", "finished")
    assert (run["num_env_steps"], run["total_env_steps"], run["iteration"]) == (2000, 2000, 2)
    trial = run["trial"]
    assert [trial[key] for key in ("task", "method", "seed", "primitives")] == ["push", "ours", 3, "tiny@1"]
    assert trial["success_low"] < trial["success"] == 0.75 < trial["success_high"]
    assert found["sparklines"] == {"downstream-push-ours-3": [0.25, 0.25]}
    curves = ask("series", runs=["downstream-push-ours-3", "cube"], names=["evaluation/success_last"])["runs"]
    assert curves[0]["curves"]["evaluation/success_last"]["mean"] == [0.75, 0.75]
    (film,) = ask("runs/downstream-push-ours-3/files")["files"]
    assert (film["name"], film["num_bytes"]) == ("episodes.mp4", len(VIDEO))
    assert ask("downstream")["rows"][0]["cells"][0]["run_ids"] == ["downstream-push-ours-3"]
    setup = ask("runs/downstream-push-ours-3/setup")
    assert setup["config"]["trial"]["reward_margin_m"] == 0.01  # a default that the file does not have
    assert setup["config"]["world"]["object"] == "cube"
    assert (setup["stop_command"], setup["resume_command"]) == (None, None)
    place = ["--registry", str(root.parent / "registry")]
    directory = str(root / "downstream" / "push-ours-3")
    assert [shlex.split(each["command"]) for each in setup["commands"]] == [
        ["tandem", "downstream", *words, *place]
        for words in (
            ["evaluate", directory],
            ["play", directory],
            ["render", directory, "--out", "push-ours-3.mp4"],
            ["publish", directory, "--name", "push-orchestrator"],
        )
    ]


def test_a_training_in_progress(root, ask):
    path = write_trial(root, "now", "push", "scratch-monolithic", 0, None, made={"primitives": None})
    (path / "tandem-error-1.txt").write_text("Traceback")
    assert ask("runs/now")["state"] == "failed"
    lock = DirectoryLock(path, "")
    run, setup = DiskReader(root).run("now"), ask("runs/now/setup", wait=1)
    lock.release()
    assert (run.state, run.last_error, run.num_env_steps, run.trial.success) == ("running", None, 2000, None)
    assert setup["stop_command"] == f"kill -INT {os.getpid()}"
    with pytest.raises(httpx.HTTPStatusError, match="404"):
        ask("runs/now/goals")


def test_a_training_takes_no_requests(root):
    lock = DirectoryLock(write_trial(root, "now", "push", "ours", 0, None), "")
    with serve(root.parent) as server, httpx.Client(base_url=server.url, headers=BEARER, **CLIENT) as client:
        answer = client.post("/v1/runs/now/stop")
    lock.release()
    assert (answer.status_code, answer.json()["type"]) == (409, "urn:tandem:not-possible")
    assert "Ctrl-C" in answer.json()["detail"]
