"""A method from a user's file is trained, recorded, killed and resumed like those that come with the package."""

import pytest

from service.base.errors import ConfigError
from service.config import load_config, parse_config
from service.runs.resuming import resumed_config
from service.runs.train import train
from service.store.models import read_status
from service.store.run_directory import RunDirectory
from tests.runs.runs import KilledError, assert_one_line, assert_same_run, newest, read_lines

CODE = """
import numpy as np
from pydantic import Field
from service.config import Config
from service.methods.method import Iteration, Method


class Climb(Method):
    def __init__(self, config):
        super().__init__()
        self.rng, self.size, self.height = np.random.default_rng(config.seed), config.step_size, 0.0

    def step(self):
        self.height += self.size * self.rng.random()
        return Iteration(self.count(10) | {"climb/height": self.height})

    def measure(self):
        return {"evaluation/height": self.height}

    def parameters(self):
        return {"height": np.array([self.height])}

    def state(self):
        return {"policy": self.parameters(), "rng": self.rng.bit_generator.state}

    def load_state(self, state):
        self.height, self.rng.bit_generator.state = float(state["policy"]["height"][0]), state["rng"]

    def close(self):
        pass


class Mine(Config):
    step_size: float = Field(1.0, gt=0.0)

    def build(self, registry, start_from):
        return Climb(self)
"""


@pytest.fixture
def file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.py").write_text(CODE)
    return tmp_path / "mine.py"


def config_of(*overrides):
    run = ["run.total_env_steps=60", "run.checkpoint_interval=2", "name=hill", "seed=4"]
    return load_config(None, ["method=mine.py:Mine", *run, *overrides])


def ignore(metrics):
    pass


@pytest.mark.usefixtures("default_signals")
def test_it_is_trained_killed_and_resumed(file, tmp_path, monkeypatch):
    def kill(metrics):
        if metrics["iteration"] == 5:
            raise KilledError

    config = config_of("step_size=0.5")
    done = train(config, RunDirectory(tmp_path / "whole"), tmp_path / "registry", on_iteration=ignore)
    with pytest.raises(KilledError):
        train(config, RunDirectory(tmp_path / "cut"), tmp_path / "registry", on_iteration=kill)
    assert newest(tmp_path / "cut").step == 4
    file.unlink()  # config.yaml has its text
    directory = RunDirectory(tmp_path / "cut")
    resumed = resumed_config(directory, [])
    assert (resumed.method, resumed.step_size, resumed.code) == ("mine.py:Mine", 0.5, {"mine.py": CODE})
    train(resumed, directory, tmp_path / "registry", resume=True, on_iteration=ignore)
    assert_same_run(tmp_path / "whole", tmp_path / "cut")
    rows = read_lines(tmp_path / "cut" / "metrics.jsonl")
    assert [row["env_steps"] for row in rows] == [10, 20, 30, 40, 50, 60]
    assert rows[-1]["climb/height"] == done.metrics["evaluation/height"] == newest(tmp_path / "cut").arrays[
        "policy/height"
    ]  # fmt: skip
    assert directory.read_result()["evaluation"] == {"height": done.metrics["evaluation/height"]}
    assert (read_status(tmp_path / "cut").state, done.version, done.files) == ("finished", None, {})
    assert not (tmp_path / "registry").exists()


@pytest.mark.parametrize(
    ("method", "key", "said"),
    [
        (
            "mine.py:Mine",
            "game.num_goals",
            "'game'; known there: code, method, name, run, seed, step_size, world",
        ),
        ("mine.py:Mine", "sac.gamma", "it is a key of method=ours"),
        ("self-play", "reward_margin_m", "it is a key of method=ours"),
        ("self-play", "distillation.batch_size", "it is a key of method=distillation"),
        ("skills", "game.num_goals", "it is a key of method=self-play"),
        ("skills", "policy.bob", "it is a key of method=self-play and distillation"),
        ("self-play", "step_size", "unknown key 'step_size'; known there: "),
        ("mine.py:Mine", "steps_size", "did you mean 'step_size'?"),
    ],
)
def test_a_key_of_one_method_is_unknown_to_another(file, method, key, said):
    with pytest.raises(ConfigError) as error:
        load_config(None, [f"method={method}", f"{key}=1"])
    assert_one_line(error.value, "unknown key", said)


@pytest.mark.usefixtures("default_signals")
@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("def step", "def steps", "mine.py:37: TypeError: Can't instantiate abstract class Climb"),
        (
            "def measure",
            "def measur",
            "mine.py: Climb.measur is no member of Method; did you mean 'measure'? The name of",
        ),
        ("self.rng.random()", "self.rng.radnom()", "mine.py:14: AttributeError: "),
        ("Iteration(self.count(10) | {", "dict(self.count(10) | {", "mine.py: step gave a dict; give an Iteration"),
        ("count(10)", "count(0)", "mine.py: 20 iterations made no env steps; say how many with self.count(NUMBER)"),
        ('"evaluation/height": self.height', '"evaluation/height": 1 / 0', "mine.py:18: ZeroDivisionError: "),
        ('"rng": self.rng.bit', '"rng": self.rgn.bit', "mine.py:24: AttributeError: "),
        (
            'return {"evaluation/height": self.height}',
            "pass",
            "mine.py: measure gave a NoneType; give metrics, numbers",
        ),
        ("count(10)", "count(-1)", "mine.py:15: ValueError: count of -1 env steps; give 0 or more"),
        ("count(10)", "count(0.5)", "mine.py:15: TypeError: 'float' object cannot be interpreted as an integer"),
        ("return Climb(self)", "return 3", "mine.py: build gave a int; give a Method"),
        ("super().__init__()", "pass", "mine.py: build gave a Climb; give one whose __init__ calls super().__init__()"),
        ("self.count(10) | {", "{", "the metrics of an Iteration lack iteration and env_steps"),
        (
            '"climb/height": self.height',
            '"climb/height": "high"',
            "mine.py: the Iteration of step gave 'climb/height': 'high'",
        ),
        (
            'return {"height": np.array([self.height])}',
            "return 3",
            "mine.py: parameters gave a int; give NumPy's arrays",
        ),
        (
            '"rng": self.rng.bit_generator.state',
            '"rng": object()',
            "mine.py: state gave what cannot be saved: Object of type object is not",
        ),
        ('"rng": self', '"n/rng": self', "mine.py: state gave what cannot be saved: 'n/rng' has a slash"),
        (
            '"rng": self.rng.bit_generator.state',
            '"rng": [{"n": (1, 2)}]',
            "mine.py: state gave what cannot be saved: 'rng' has a tuple, which comes back as a list",
        ),
        (
            '"rng": self.rng.bit_generator.state',
            '"rng": {1: 2}',
            "mine.py: state gave what cannot be saved: 'rng' has keys that are no text",
        ),
        ("np.array([self.height])", "self.height", "mine.py: parameters, 'height', gave a float; give one of NumPy's"),
        ("np.array([self.height])", "np.array(['high'])", "mine.py: state gave what cannot be saved: "),
    ],
)
def test_an_error_of_the_method_names_its_line(file, tmp_path, monkeypatch, old, new, said):
    monkeypatch.setattr("service.runs.run.MAX_IDLE", 20)
    assert old in CODE
    file.write_text(CODE.replace(old, new))
    with pytest.raises(ConfigError) as error:
        train(config_of(), RunDirectory(tmp_path / "run"), tmp_path / "registry", on_iteration=ignore)
    assert_one_line(error.value, said)


@pytest.mark.usefixtures("default_signals")
def test_numbers_of_numpys_count(file, tmp_path):
    text = CODE.replace("count(10)", "count(np.int64(10))")
    file.write_text(text.replace('"climb/height": self.height', '"climb/height": np.array(2.0)'))
    train(config_of(), RunDirectory(tmp_path / "run"), tmp_path / "registry", on_iteration=ignore)
    rows = read_lines(tmp_path / "run" / "metrics.jsonl")
    assert [(row["env_steps"], row["climb/height"]) for row in rows] == [(10 * step, 2.0) for step in range(1, 7)]


@pytest.mark.usefixtures("default_signals")
def test_what_it_measures_that_is_no_number_is_told(file, tmp_path, caplog):
    file.write_text(CODE.replace('{"evaluation/height": self.height}', '{"evaluation/height": float("nan")}'))
    train(config_of(), RunDirectory(tmp_path / "run"), tmp_path / "registry", on_iteration=ignore)
    assert "measured, and no finite number: evaluation/height" in caplog.text


@pytest.mark.parametrize(
    ("method", "said"),
    [
        (
            "mine.py:Climb",
            "mine.py:Climb: no class that derives from Config of that name",
        ),
        ("mine.py:Yours", "mine.py:Yours: no class that derives from Config of that name"),
        ("unbuilt.py", "unbuilt.py: Mine has no build(self, registry, start_from), which makes the Method"),
        ("gone.py:Mine", "gone.py: no such file"),
        ("bad.py:Mine", "bad.py:1: ZeroDivisionError: division by zero"),
        ("notes.txt:Mine", "notes.txt: no module of that name"),
        ("self_play", "method = 'self_play': choose one of self-play"),
    ],
)
def test_what_is_no_method(file, tmp_path, method, said):
    (tmp_path / "bad.py").write_text("1 / 0")
    (tmp_path / "unbuilt.py").write_text(CODE.replace("def build", "def bulid"))
    (tmp_path / "notes.txt").write_text("class Mine: ...")
    with pytest.raises(ConfigError) as error:
        parse_config({"method": method}, where="a test")
    assert_one_line(error.value, "a test: ", said)
