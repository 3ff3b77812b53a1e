"""A method from a user's file is trained, recorded, killed and resumed like those that come with the package."""

from functools import partial

import pytest

from service.base.errors import ConfigError, TandemError
from service.config import load_config, parse_config
from service.runs import train as training
from service.runs.resuming import resumed_config
from service.store.models import read_status
from service.store.run_directory import RunDirectory
from tests.runs.runs import KilledError, assert_one_line, assert_same_run, newest, read_lines

train = partial(training.train, publish=False)
"""As the command does of what makes nothing that can be published."""
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
        ("self.count(10) | {", "{", "step counted iterations: 0, and gave an Iteration: call self.count(NUMBER) once"),
        ("return Iteration(", "Iteration(", "step counted iterations: 1, and gave None: call self.count(NUMBER) once"),
        (
            "self.count(10) | {",
            "self.count(0) | self.count(10) | {",
            "step counted iterations: 2, and gave an Iteration",
        ),
        ('"climb/height": self.height', '"env_steps": 7', "lack its iteration and env_steps: begin them with what"),
        ('"climb/height": self.height', '"iteration": float("nan")', "lack its iteration and env_steps"),
        (
            "self.height})",
            "self.height}, np.zeros((5, 3)))",
            "the goals of an Iteration are float64 of shape (5, 3); give numbers of shape (M, 7)",
        ),
        (
            "self.height += ",
            "self.converged = np.zeros(2); self.height += ",
            "mine.py: converged gave a ndarray; give a",
        ),
        ("self.height += ", "open('gone'); self.height += ", "mine.py:14: FileNotFoundError: "),
        ("self.height += ", "raise SystemExit(0); self.height += ", "mine.py:14: SystemExit: 0"),
        ("0.0\n", "0.0; self.grid = np.zeros(3)\n", "mine.py: self.grid hides grid() of every Method; give it another"),
        (
            "0.0\n",
            "0.0; self.timing = 0.0\n",
            "mine.py: self.timing gave a float; give it another name, such as _timing",
        ),
        (
            '"climb/height": self.height',
            '"climb/height": "high"',
            "mine.py: the Iteration of step gave {'climb/height': 'high'}; give numbers by names",
        ),
        (
            'return {"height": np.array([self.height])}',
            "return 3",
            "mine.py: parameters gave a int; give NumPy's arrays",
        ),
        (
            '"rng": self.rng.bit_generator.state',
            '"rng": object()',
            "mine.py: state gave what cannot be saved: 'rng' has a object; give arrays of numbers, and of a state",
        ),
        ('"rng": self', '"n/rng": self', "mine.py: state gave what cannot be saved: 'n/rng' has a slash"),
        ('"rng": self', '"&": self', "mine.py: state gave what cannot be saved: the name '&' is used here"),
        ('"rng": self', "1: self", "mine.py: state gave what cannot be saved: the name 1 is no text"),
        (
            '"rng": self',
            '"odd": [np.zeros(2, complex)], "rng": self',
            "'odd' has an array with dtype complex128; use one",
        ),
        (
            "def close",
            "def start(self, state=None):\n        raise ValueError('real')\n\n    def close",
            "ValueError: real",
        ),
        (
            "return Iteration(",
            "self.health = 3; return Iteration(",
            "mine.py: self.health hides health() of every Method",
        ),
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
def test_goals_of_several_objects_are_recorded(file, tmp_path):
    file.write_text(CODE.replace("self.height})", "self.height}, goals=np.full((2, 13), 0.1))"))
    directory = RunDirectory(tmp_path / "run")
    train(config_of("world.objects=[cube, cube]"), directory, tmp_path / "registry", on_iteration=ignore)
    assert read_lines(directory.goals_file)[-1]["goals"] == [[0.1] * 13] * 2


@pytest.mark.usefixtures("default_signals", "file")
def test_what_makes_nothing_to_publish_is_refused_before_it_learns(tmp_path):
    directory = RunDirectory(tmp_path / "run")
    with pytest.raises(TandemError, match="makes nothing that can be published"):
        train(config_of(), directory, tmp_path / "registry", publish=True, on_iteration=ignore)
    assert not directory.exists


@pytest.mark.usefixtures("default_signals")
def test_what_the_run_says_is_not_evaluated(file, tmp_path):
    file.write_text(
        CODE.replace("def parameters", 'def evaluate(self):\n        return {"env_steps": 3}\n\n    def parameters')
    )
    config = config_of("run.evaluation_interval=1")
    with pytest.raises(ConfigError) as error:
        train(config, RunDirectory(tmp_path / "run"), tmp_path / "registry", on_iteration=ignore)
    assert_one_line(error.value, "mine.py: evaluate gave env_steps, which the run says; leave them out")


@pytest.mark.usefixtures("default_signals")
def test_its_result_is_there_whatever_its_end_raises(file, tmp_path, caplog):
    text = CODE.replace('{"evaluation/height": self.height}', '{"evaluation/height": 2.0, "height": 1.0}')
    file.write_text(
        text.replace("def close(self):\n        pass", 'def close(self):\n        raise ValueError("bad end")')
    )
    directory = RunDirectory(tmp_path / "run")
    train(config_of(), directory, tmp_path / "registry", on_iteration=ignore)
    assert directory.read_result()["evaluation"] == {"height": 1.0, "evaluation/height": 2.0}
    assert read_status(tmp_path / "run").state == "finished"
    assert [each.message for each in caplog.records if "bad end" in each.message] == [
        "mine.py:30: ValueError: bad end; what the run has learned is there"
    ]


@pytest.mark.usefixtures("default_signals")
def test_an_error_at_its_start_is_not_hidden_by_one_at_its_end(file, tmp_path):
    text = CODE.replace("def close(self):\n        pass", 'def close(self):\n        raise KeyError("end")')
    file.write_text(
        text.replace("def measure", 'def start(self, state=None):\n        raise ValueError("real")\n\n    def measure')
    )
    with pytest.raises(ConfigError, match="ValueError: real"):
        train(config_of(), RunDirectory(tmp_path / "run"), tmp_path / "registry", on_iteration=ignore)


@pytest.mark.usefixtures("default_signals")
def test_metrics_of_the_status_may_be_nan(file, tmp_path):
    text = CODE.replace('"climb/height": self.height', '"learner/version": float("nan"), "learner/policy_lag": None')
    file.write_text(text)
    train(config_of(), RunDirectory(tmp_path / "run"), tmp_path / "registry", on_iteration=ignore)
    assert (read_status(tmp_path / "run").policy_version, read_status(tmp_path / "run").policy_lag) == (0, 0.0)


@pytest.mark.usefixtures("default_signals")
def test_a_metric_that_is_not_finite_is_told_once(file, tmp_path, caplog):
    file.write_text(CODE.replace('"climb/height": self.height', '"climb/height": float("inf")'))
    train(config_of(), RunDirectory(tmp_path / "run"), tmp_path / "registry", on_iteration=ignore)
    said = "mine.py: the Iteration of step gave climb/height = inf, which is recorded as missing"
    assert [each.message for each in caplog.records].count(said) == 1


@pytest.mark.usefixtures("default_signals")
def test_a_state_may_be_nested(file, tmp_path, capsys):
    """Arrays and NumPy's numbers beside plain values, in dictionaries and lists, come back as they were."""
    state = """{
            "policy": self.parameters(), "rng": self.rng.bit_generator.state, "top": np.arange(3),
            "one": np.float32(0.1), "deep": {"m": [np.ones(2), {"t": np.int64(4)}], "n": None}, "n": 3}"""
    text = CODE.replace('{"policy": self.parameters(), "rng": self.rng.bit_generator.state}', state).replace(
        "        self.height, self.rng.bit_generator.state = ",
        """
        assert state["top"].tolist() == [0, 1, 2]
        assert state["one"] == np.float32(0.1) and type(state["one"]) is np.float32
        ones, rest = state["deep"]["m"]
        assert ones.tolist() == [1, 1] and type(rest["t"]) is np.int64 and rest["t"] == 4
        assert state["deep"]["n"] is None and state["n"] == 3
        print("all is back")
        self.height, self.rng.bit_generator.state = """,
    )
    file.write_text(text)
    directory = RunDirectory(tmp_path / "run")
    train(config_of(), directory, tmp_path / "registry", on_iteration=ignore)
    config = resumed_config(directory, ["run.total_env_steps=80"])
    assert train(config, directory, tmp_path / "registry", resume=True, on_iteration=ignore).num_env_steps == 80
    assert "all is back" in capsys.readouterr().out


@pytest.mark.usefixtures("default_signals")
def test_an_environment_goes_on_where_it_was(file, tmp_path):
    """As ``docs/own_method.md`` says: a resumed run has the rewards of one that was not cut."""
    text = CODE.replace(
        "import numpy", "from dataclasses import asdict\nfrom tandem_skills import EnvState, make_env\nimport numpy"
    )
    text = text.replace(
        "0.0\n", "0.0\n        self.env = make_env('push', num_envs=2)\n        self.env.reset(seed=3)\n", 1
    )
    text = text.replace(
        "self.rng.random()", "float(self.env.step(self.env.action_space.sample() * 0 + 0.3)[0]['observation'].sum())"
    )
    text = text.replace('{"policy"', '{"env": asdict(self.env.state()), "policy"')
    text = text.replace(
        "        self.height, self.rng",
        "        self.env.restore(EnvState(**state['env']))\n        self.height, self.rng",
    )
    file.write_text(text.replace("def close(self):\n        pass", "def close(self):\n        self.env.close()"))
    for name, budgets in (("whole", (60,)), ("cut", (20, 60))):
        directory = RunDirectory(tmp_path / name)
        for budget in budgets:
            again = directory.exists
            settings = [f"run.total_env_steps={budget}"]
            config = resumed_config(directory, settings) if again else config_of(*settings)
            train(config, directory, tmp_path / "registry", resume=again, on_iteration=ignore)
    rows = [[row["climb/height"] for row in read_lines(tmp_path / name / "metrics.jsonl")] for name in ("whole", "cut")]
    assert rows[0] == rows[1]
    assert len(set(rows[0])) == 6


def test_a_run_without_a_name_has_that_of_the_file(file):
    assert load_config(None, ["method=mine.py:Mine"]).name == "mine"
    assert load_config(None, ["method=mine.py:Mine", "name=hill"]).name == "hill"
    with pytest.raises(ConfigError) as error:
        load_config(None, ["method=mine.py:Mine", "task=push"])
    assert_one_line(error.value, "mine.py:Mine learns no task: leave out task = 'push'")


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
