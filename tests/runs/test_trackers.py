"""Trackers: what they get, that one which throws takes nothing else along, and bad names."""

import json
import sys

import pytest

from service.base.errors import TandemError
from service.runs.trackers import Trackers
from tests.cli.typed import assert_refused, tandem
from tests.methods.trials import SETS
from tests.runs.runs import TREE, assert_one_line, read_lines, write_yaml

CODE = """
import json, pathlib

class File:
    def __init__(self, name, config):
        self.lines = open(f"{name}.txt", "a")
        print(json.dumps([name, config]), file=self.lines)

    def log(self, metrics, step):
        print(json.dumps([step, metrics]), file=self.lines)

    def close(self):
        print('"closed"', file=self.lines)
        self.lines.close()

class Throws:
    def __init__(self, name, config):
        self.calls = []
        made.append(self)

    def log(self, metrics, step):
        self.calls.append(step)
        if len(self.calls) == 2:
            raise OSError("no way\\nto there")

    def finish(self):
        self.calls.append("finished")
        raise OSError("again")

made = []
number = 7

def no_log(name, config):
    return number

def refuses(name, config):
    raise RuntimeError("log in first")
"""


@pytest.fixture(autouse=True)
def written(tmp_path, monkeypatch, no_artifacts):
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("TANDEM_REDIS_URL", raising=False)
    (tmp_path / "trackers_of_a_test.py").write_text(CODE)
    yield
    sys.modules.pop("trackers_of_a_test", None)


def read(path):
    return [json.loads(line) for line in path.read_text().splitlines()]


@pytest.mark.usefixtures("default_signals")
def test_a_run_gives_them_every_record_and_goes_on_without_one_that_throws(tmp_path, caplog):
    mine = ["--tracker", "trackers_of_a_test:File", "--tracker", "trackers_of_a_test:Throws"]
    config = write_yaml(tmp_path / "tiny.yaml", {**TREE, "run": {**TREE["run"], "total_env_steps": 900}})
    done = tandem("pretrain", "--config", config, "--run-dir", "runs/one", "--registry", "registry", *mine)
    assert done.exit_code == 0, done.output
    (name, told), *records, last, closed = read(tmp_path / "one.txt")
    assert (name, told["name"], told["run"]["total_env_steps"], closed) == ("one", "tiny", 900, "closed")
    recorded = read_lines(tmp_path / "runs" / "one" / "metrics.jsonl")
    assert len(recorded) > 2
    assert records == [[each["env_steps"], each] for each in recorded]
    assert last[0] == recorded[-1]["env_steps"]
    assert {"final/table_success_last", "final/mixed_success_ever"} <= last[1].keys()
    (throws,) = sys.modules["trackers_of_a_test"].made
    assert throws.calls == [*(each["env_steps"] for each in recorded[:2]), "finished"]
    said = [each.getMessage() for each in caplog.records if "left out" in each.getMessage()]
    assert said == [
        "tracker trackers_of_a_test:Throws is left out from now on, the run goes on: OSError: no way to there"
    ]


def test_learning_a_task_has_them_too(tmp_path, champion):
    done = tandem("train", "wall", *SETS, "--tracker", "trackers_of_a_test:File")
    assert done.exit_code == 0, done.output
    (name, told), *records, last, closed = read(tmp_path / "wall-ours-0.txt")
    assert (name, told["task"], told["primitives"], closed) == (
        "wall-ours-0",
        "wall",
        champion.manifest.reference,
        "closed",
    )
    assert records[-1][0] == last[0] == 600
    assert "learner/num_updates" in records[-1][1]
    assert 0.0 <= last[1]["final/success_last"] <= 1.0


@pytest.mark.parametrize(
    ("reference", "said"),
    [
        ("json", "write module:factory"),
        (":File", "write module:factory"),
        ("no_such_module_here:File", "cannot be loaded: ModuleNotFoundError: No module named 'no_such_module_here'"),
        ("trackers_of_a_test:Nothing", "cannot be loaded: AttributeError"),
        ("trackers_of_a_test:number", "'int' object is not callable"),
        ("trackers_of_a_test:no_log", "made something without log, of type int"),
        ("trackers_of_a_test:refuses", "RuntimeError: log in first"),
    ],
)
def test_one_that_is_none_is_refused_before_the_run(tmp_path, reference, said):
    before = list(sys.path)
    done = tandem(
        "pretrain", "--config", write_yaml(tmp_path / "tiny.yaml"), "--run-dir", "run", "--tracker", reference
    )
    assert_refused(done, f"--tracker '{reference}'", said)
    assert sys.path == before
    assert not (tmp_path / "run").exists()


def test_those_made_before_one_that_cannot_be_are_ended(tmp_path):
    with pytest.raises(TandemError, match="log in first") as caught:
        Trackers(["trackers_of_a_test:File", "trackers_of_a_test:refuses"], "run", {})
    assert_one_line(caught.value)
    assert read(tmp_path / "run.txt") == [["run", {}], "closed"]
