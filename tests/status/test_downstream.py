"""Runs that learn a task: the table of tasks, the list, the page of one, and stopping and resuming one."""

import json
import os
import shlex
import subprocess
import sys

import httpx
import pytest

from service.registry.registry import Registry
from service.status.task_table import task_table
from service.store.disk_reader import DiskReader
from tests.status.conftest import serve
from tests.status.runs import BEARER, CLIENT, VIDEO, publish, write_runs, write_trial
from tests.store.stores import wait_until

OTHERS = {"primitives": "other@2", "primitives_digest": "1" * 64}


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
    reader = DiskReader(root)
    return task_table(reader.runs(), reader.directories())


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
    write_trial(root, "b", "push", "ours", 1, 0.4, total_env_steps=4000)
    write_trial(root, "c", "wall", "ours", 0, 0.6, total_env_steps=4000)
    write_trial(root, "d", "push", "ours", 0, 0.8, **OTHERS)
    write_trial(root, "e", "push", "ours", 0, 0.9, world={"object": "cube", "object_mass_kg": 0.3})
    found = table(root)
    assert shown(found) == [
        ("ours", "other@2", {"push": 0.8}),
        ("ours", "tiny@1", {"push": 0.4, "wall": 0.6}),
        ("ours", "tiny@1", {"push": 0.2}),
        ("ours", "tiny@1", {"push": 0.9}),
    ]
    longer = {"run.total_env_steps": 4000, "world.object_mass_kg": 0.1}
    assert [cell.differs for cell in found.rows[1].cells] == [longer] * 2
    assert found.rows[3].cells[0].differs == {"run.total_env_steps": 2000, "world.object_mass_kg": 0.3}
    assert found.rows[0].cells[0].differs == {}


def test_two_versions_of_what_learns_make_two_rows(root):
    old = write_trial(root, "a", "push", "ours", 0, 0.2) / "result.json"
    write_trial(root, "b", "push", "ours", 1, 0.4)
    write_trial(root, "c", "wall", "ours", 0, 0.6)
    result = json.loads(old.read_text())
    del result["made"]["learning_version"]  # as until version 1
    old.write_text(json.dumps(result))
    assert shown(table(root)) == [("ours", "tiny@1", {"push": 0.4, "wall": 0.6}), ("ours", "tiny@1", {"push": 0.2})]
    assert table(root).rows[1].cells[0].differs == {"learning_version": 1}


def test_what_no_result_depends_on_makes_no_row(root):
    """Tasks may have had different budgets; seeds may have had different names, threads and registries."""
    write_trial(root, "a", "push", "ours", 0, 0.2, total_env_steps=3000)
    write_trial(root, "b", "wall", "ours", 0, 0.4)
    run = {"total_env_steps": 2000, "num_threads": 4}
    write_trial(root, "c", "wall", "ours", 1, 0.6, run=run, name="mine", primitives="/srv/tiny@1")
    write_trial(root, "d", "wall", "scratch-mcp", 0, 0.0)
    rows = [("ours", "tiny@1", {"push": 0.2, "wall": 0.5}), ("scratch-mcp", None, {"wall": 0.0})]
    assert shown(table(root)) == rows


def test_of_a_seed_that_was_run_twice_the_newer_counts(root):
    older = write_trial(root, "z", "push", "ours", 0, 0.2)
    write_trial(root, "b", "push", "ours", 0, 0.4)
    write_trial(root / "night", "c", "push", "ours", 1, None)
    (root / "night" / "study.json").touch()
    os.utime(older / "result.json", (1, 1))
    (cell,) = table(root).rows[0].cells
    assert (cell.success, cell.run_ids, cell.unfinished) == (0.4, ("b",), ("night-c",))


def test_a_result_of_a_shorter_training_or_of_something_else_is_none(root):
    longer = write_trial(root, "a", "push", "ours", 0, 0.2, total_env_steps=4000)
    other = write_trial(root, "b", "push", "ours", 1, 0.4, total_env_steps=4000)
    sooner = write_trial(root, "c", "push", "ours", 2, 0.6, total_env_steps=4000)  # it has converged
    for path, file, changed in (
        (longer, "result.json", {"env_steps": 3000}),
        (longer, "status.json", {"state": "interrupted"}),
        (other, "result.json", {"evaluation": {"coverage": 0.5}}),
        (sooner, "result.json", {"env_steps": 3000}),
    ):
        (path / file).write_text(json.dumps(json.loads((path / file).read_text()) | changed))
    (cell,) = table(root).rows[0].cells
    assert (cell.success, cell.run_ids, cell.unfinished) == (0.6, ("c",), ("a", "b"))


def test_what_is_damaged_or_unknown_hides_nothing_else(root):
    write_trial(root, "good", "push", "ours", 0, 0.4)
    write_trial(root, "future", "juggle", "telepathy", 0, 0.6, task_version=7)
    (write_trial(root, "begins", "push", "ours", 5, None) / "config.yaml").unlink()
    own = f"{root}/own.py:Own"
    config = write_trial(root, "own", "push", own, 0, 0.9) / "config.yaml"
    config.write_text(config.read_text()[:-1] + ', "day": 2026-01-01}')  # a date, which JSON has not
    (root / "own.py").write_text("raise SystemExit('a status service runs no method')")
    for name, file, text in (
        ("no-yaml", "config.yaml", "{"),
        ("no-keys", "config.yaml", "7"),
        ("no-result", "result.json", '{"evaluation": {}}'),
        ("no-number", "result.json", '{"evaluation": NaN}'),
    ):
        (write_trial(root, name, "push", "ours", 9, 0.1) / file).write_text(text)
    found = table(root)
    assert shown(found) == [
        ("ours", "tiny@1", {"push": 0.4}),
        (own, "tiny@1", {"push": 0.9}),
        ("telepathy", "tiny@1", {"juggle": 0.6}),
    ]
    assert [task.version for task in found.tasks] == [1, 7]
    damaged = ("no-keys/config.yaml", "no-number/result.json", "no-result/result.json", "no-yaml/config.yaml")
    assert sorted(text.split(":")[0].split(" ")[0] for text in found.problems) == [f"{root}/{name}" for name in damaged]


# --- runs, over HTTP ------------------------------------------------------------------------------------------------


def test_a_run_that_learns_a_task_is_a_run(root, ask):
    path = write_trial(root, "push-ours-3", "push", "ours", 3, 0.75)
    (path / "episodes.mp4").write_bytes(VIDEO)
    (root / "older").mkdir()
    (root / "older" / "cell.json").write_text('{"format_version": 1}')  # of version 0.2, which kept no run directory
    assert ask("runs")["num_runs"] == 3
    assert {run["run_id"] for run in ask("runs", downstream=False)["runs"]} == {"cube", "old"}
    found = ask("runs", downstream=True, sparkline=["bob/success_rate", "rollout/success_last"])
    (run,) = found["runs"]
    assert (run["run_id"], run["name"], run["state"]) == ("push-ours-3", "push-ours", "finished")
    trial = run["trial"]
    assert [trial[key] for key in ("task", "method", "seed", "primitives")] == ["push", "ours", 3, "tiny@1"]
    assert trial["success_low"] < trial["success"] == 0.75 < trial["success_high"]
    assert found["sparklines"] == {"push-ours-3": [0.25, 0.25]}
    curves = ask("series", runs=["push-ours-3", "cube"], names=["evaluation/success_last"])["runs"]
    assert curves[0]["curves"]["evaluation/success_last"]["mean"] == [0.75, 0.75]
    (film,) = ask("runs/push-ours-3/files")["files"]
    assert (film["name"], film["num_bytes"]) == ("episodes.mp4", len(VIDEO))
    assert ask("downstream")["rows"][0]["cells"][0]["run_ids"] == ["push-ours-3"]
    with pytest.raises(httpx.HTTPStatusError, match="404"):
        ask("runs/push-ours-3/goals")


TINY = ("sac.num_worlds=4", "sac.gradient_steps=1", "sac.batch_size=16", "sac.learning_starts=200")
TINY += ("sac.hidden_sizes=[8]", "run.evaluation_interval=0", "run.num_threads=1", "run.total_env_steps=100000000")


@pytest.fixture
def train(tmp_path, default_signals):
    """Start ``tandem train`` in a process of its own, which makes no film."""
    processes = []

    def _train(*words):
        command = [sys.executable, "-m", "service", "train", *words, "--run-dir", tmp_path / "runs" / "wall"]
        processes.append(subprocess.Popen(command, env={**os.environ, "MUJOCO_GL": "off"}))
        return processes[-1]

    yield _train
    for process in processes:
        process.kill()
        process.wait()


def test_one_is_stopped_over_rest_and_resumed_by_its_directory_alone(tmp_path, train):
    """A real training and a real service: what happened to the run is in its log."""
    (tmp_path / "runs").mkdir()
    with serve(tmp_path) as server, httpx.Client(base_url=server.url, headers=BEARER, **CLIENT) as client:

        def ask(path=""):
            return client.get(f"/v1/runs/wall{path}").raise_for_status().json()

        def stop_after(process, iteration):
            """Stop it once it is so far, and give its status then."""
            wait_until(
                lambda: (
                    client.get("/v1/runs/wall").is_success
                    and (now := ask())["state"] == "running"
                    and now["iteration"] >= iteration
                )
            )
            assert client.post("/v1/runs/wall/stop").json()["stopping"]
            assert process.wait(300) == 0
            return ask()

        stopped = stop_after(train("wall", "--method", "scratch-monolithic", *(f"--set={each}" for each in TINY)), 3)
        assert (stopped["state"], stopped["trial"]["method"]) == ("interrupted", "scratch-monolithic")
        resume = shlex.split(ask("/setup")["resume_command"])
        assert resume[:5] == ["tandem", "train", "--resume", "--run-dir", str(tmp_path / "runs" / "wall")]
        again = stop_after(train("--resume"), stopped["iteration"] + 2)
        assert (again["state"], again["epoch"]) == ("interrupted", 2)
        assert ask("/metrics")["iteration"] == list(range(1, again["iteration"] + 1))
        said = [entry["text"] for entry in ask("/log")["entries"]]
        assert f"resumed at iteration {stopped['iteration']}, {stopped['num_env_steps']} env steps" in said
        (row,) = client.get("/v1/downstream").json()["rows"]
        assert (row["primitives"], row["cells"][0]["unfinished"]) == (None, ["wall"])
