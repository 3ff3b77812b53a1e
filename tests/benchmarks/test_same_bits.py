"""The referee of bits: two run directories by hand, equal or different in one thing."""

import json

import numpy as np
import pytest
from safetensors.numpy import save_file

from benchmarks import same_bits
from benchmarks.same_bits import Row, compare_runs
from service.base.errors import TandemError

ROW = Row("a row", "")


def header(env_steps=20, words=(1, 2**100), wall_s=3.5):
    meta = {
        "env_steps": env_steps,
        "wall_s": wall_s,
        "state": {"rng": {"state": list(words)}},
        "config": {"seed": wall_s},
    }
    return {"tandem_checkpoint": json.dumps({"format_version": 1, "step": 2, "meta": meta, "sha256": str(wall_s)})}


def records(*losses, time_s=1.0):
    return [
        {"iteration": number, "loss": loss, "time/play_s": time_s + number} for number, loss in enumerate(losses, 1)
    ]


def make_run(path, weights=(0.0, 1.0), metrics=None, *, name="bob/weight", dtype=np.float32, **changed):
    (path / "checkpoints").mkdir(parents=True)
    arrays = {name: np.array(weights, dtype), "steps": np.array(7, np.int64)}
    save_file(arrays, path / "checkpoints" / "checkpoint-e00000002-00000002.safetensors", metadata=header(**changed))
    old = {"steps": np.zeros(3)}  # of a process before, after more steps
    save_file(old, path / "checkpoints" / "checkpoint-e00000001-00000009.safetensors")
    lines = {"metrics.jsonl": metrics or records(0.0, 0.25), "goals.jsonl": [{"iteration": 1, "goals": [[0.1, 0.0]]}]}
    for file, each in lines.items():
        (path / file).write_text("".join(json.dumps(line) + "\n" for line in each))
    return path


def differing(tmp_path, row=ROW, **changed):
    return compare_runs(make_run(tmp_path / "old"), make_run(tmp_path / "new", **changed), row)["differing"]


def test_equal_runs_at_other_times(tmp_path):
    old = make_run(tmp_path / "old")
    new = make_run(tmp_path / "new", metrics=records(0.0, 0.25, time_s=9.0), wall_s=9.0)
    assert compare_runs(old, new, ROW) == {"num_arrays": 2, "num_records": 3, "differing": []}


@pytest.mark.parametrize(
    ("changed", "expected"),
    [
        ({"weights": (0.0, np.nextafter(np.float32(1.0), np.float32(2.0)))}, ["checkpoint/bob/weight"]),
        ({"weights": (-0.0, 1.0)}, ["checkpoint/bob/weight"]),
        ({"weights": ((0.0, 1.0),)}, ["checkpoint/bob/weight"]),
        ({"weights": (0, 0x3F800000), "dtype": np.int32}, ["checkpoint/bob/weight"]),
        ({"name": "bob/weights"}, ["checkpoint/bob/weight", "checkpoint/bob/weights"]),
        ({"words": (1, 2**100 + 1)}, ["header/meta/state/rng/state/1"]),
        ({"env_steps": 21}, ["header/meta/env_steps"]),
        ({"metrics": records(-0.0, 0.25)}, ["metrics.jsonl/loss from record 1 on"]),
        ({"metrics": records(0.0, 0.25000000000000006)}, ["metrics.jsonl/loss from record 2 on"]),
        (
            {"metrics": records(0.0)},
            ["metrics.jsonl/iteration from record 2 on", "metrics.jsonl/loss from record 2 on"],
        ),
        ({"metrics": [*records(0.0), {"iteration": 2}]}, ["metrics.jsonl/loss from record 2 on"]),
        ({"metrics": [*records(0.0), {"iteration": 2, "loss": 0.25, "kl": 0}]}, ["metrics.jsonl/kl from record 2 on"]),
    ],
)
def test_one_difference(tmp_path, changed, expected):
    assert differing(tmp_path, **changed) == expected


def test_goals_of_one_run_only(tmp_path):
    old, new = make_run(tmp_path / "old"), make_run(tmp_path / "new")
    (new / "goals.jsonl").unlink()
    found = compare_runs(old, new, ROW)
    assert found["num_records"] == 2
    assert found["differing"] == ["goals.jsonl/goals from record 1 on", "goals.jsonl/iteration from record 1 on"]


def test_late_metrics_may_come_with_another_record(tmp_path):
    row = Row("a row", "", late=("loss",))
    old = make_run(tmp_path / "old", metrics=[{"iteration": 1, "loss": 0.5}, {"iteration": 2}])
    new = make_run(tmp_path / "new", metrics=[{"iteration": 1}, {"iteration": 2, "loss": 0.5}])
    other = make_run(tmp_path / "other", metrics=[{"iteration": 1}, {"iteration": 2, "loss": 0.25}])
    assert compare_runs(old, new, row)["differing"] == []
    assert compare_runs(old, other, row)["differing"] == ["metrics.jsonl/loss"]
    assert compare_runs(old, new, ROW)["differing"] == ["metrics.jsonl/loss from record 1 on"]


def test_nothing_to_compare(tmp_path):
    old, new = make_run(tmp_path / "old"), make_run(tmp_path / "new")
    for checkpoint in (new / "checkpoints").iterdir():
        checkpoint.unlink()
    with pytest.raises(TandemError, match=r"no checkpoint in .*new"):
        compare_runs(old, new, ROW)
    (old / "metrics.jsonl").unlink()
    with pytest.raises(FileNotFoundError):
        compare_runs(old, old, ROW)


def test_report_by_hand():
    row = {"num_arrays": 2, "num_records": 3, "differing": list("abcdef"), "seconds": 61.4}
    rows = {"self-play": row, "lsd": row | {"differing": []}}
    assert same_bits.report({"rows": rows}).splitlines()[2:] == [
        "| self-play | 2 | 3 | a, b, c, d and 2 more | 61 |",
        "| lsd | 2 | 3 | nothing | 61 |",
    ]
