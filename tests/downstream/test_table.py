import dataclasses
import functools
import json

import pytest

from service.downstream.rates import by_method_and_task, rate_of, seed_interval
from service.downstream.results import ResultsDirectory
from service.downstream.table import Source, make_table, run_here, run_on_ray, success_table
from service.downstream.worker import Callbacks
from service.errors import TandemError
from tests.downstream.trials import small_trial

HERE, ON_RAY = functools.partial(run_here, num_threads=1), functools.partial(run_on_ray, num_workers=2)
TRIALS = [small_trial(method, task) for task in ("push", "box") for method in ("idle", "asp-only")]


@pytest.fixture
def source(tmp_path):
    return Source("panda-cube@champion", "no registry here", tmp_path / "runs")


def counted(ran, before=None):
    """A runner that keeps the names of what it ran, and calls ``before`` before each."""

    def run(trials, *rest):
        for trial, result in HERE(trials, *rest):
            ran.append(trial.name)
            yield trial, result
            if before is not None:
                before()

    return run


def table(trials, source, tmp_path, runner=None, **watching):
    return make_table(trials, source, tmp_path / "out", runner or HERE, Callbacks(**watching))


def test_a_table_runs_what_is_missing_and_nothing_else(source, tmp_path):
    ran = []

    class KilledError(Exception):
        pass

    def kill():
        if len(ran) == 2:
            raise KilledError

    with pytest.raises(KilledError):
        table(TRIALS, source, tmp_path, counted(ran, kill))
    results = tmp_path / "out" / "downstream"
    assert sorted(path.name for path in results.iterdir()) == ["push-asp-only-0.json", "push-idle-0.json"]
    stamps = {path: path.stat().st_mtime_ns for path in results.iterdir()}
    assert table(TRIALS, source, tmp_path, counted(ran))
    assert ran == [trial.name for trial in TRIALS]
    assert all(path.stat().st_mtime_ns == stamp for path, stamp in stamps.items())
    head, played, idle = success_table(tmp_path / "out")
    assert (head, played[0], idle[0]) == (("method", "push", "box"), "asp-only", "idle")
    assert idle[1] == "16.7 % [3, 56]* (1)"  # 1 of 6, Wilson (z = 1.96)


def test_a_stopped_table_says_so_and_continues_its_training(source, tmp_path):
    asked = []

    def stop():
        asked.append(True)
        return len(asked) > 2

    trials = [small_trial(), small_trial("idle")]
    assert not table(trials, source, tmp_path, stop=stop)
    assert (source.runs / "push-ours-0" / "checkpoints").exists()
    assert not (tmp_path / "out" / "downstream").exists()
    assert table(trials, source, tmp_path)
    lines = (source.runs / "push-ours-0" / "metrics.jsonl").read_text().splitlines()
    assert [json.loads(line)["iteration"] for line in lines] == [1, 2, 3]


def test_how_to_learn_is_nothing_to_what_does_not(source, tmp_path):
    table(TRIALS[:1], source, tmp_path)
    ran = []
    assert table([small_trial("idle", num_env_steps=9000)], source, tmp_path, counted(ran))
    assert ran == []


def test_new_primitives_leave_what_takes_none(champion, source, tmp_path):
    scratch = small_trial("scratch-monolithic")
    table([scratch, *TRIALS[:2]], source, tmp_path)
    newer = dataclasses.replace(champion, manifest=champion.manifest.model_copy(update={"version": 99}))
    results = ResultsDirectory(tmp_path / "out" / "downstream")
    assert results.find(scratch, newer)["primitives"] is None
    assert results.find(TRIALS[0], newer)["world"] == champion.config.world.model_dump(mode="json")
    with pytest.raises(TandemError, match=rf"primitives\.name '{champion.manifest.reference}', not 'panda-cube@99'"):
        results.find(TRIALS[1], newer)


def test_a_stop_between_cells_that_do_not_learn(source, tmp_path):
    ran = []
    assert not table(TRIALS, source, tmp_path, counted(ran), stop=lambda: len(ran) >= 1)
    assert ran == [TRIALS[0].name]


def test_many_at_once_on_ray(source, tmp_path):
    from service.runtime.ray_connection import connected

    with connected(None, num_cpus=2):
        assert table(TRIALS[:2], source, tmp_path, ON_RAY)
        other = [small_trial("idle", num_episodes=9)]  # where a training directory of that name is of other settings
        with pytest.raises(TandemError, match="num_episodes 6, not 9") as caught:
            make_table(other, source, tmp_path / "other", run_on_ray, Callbacks())
    assert "\n" not in str(caught.value)
    assert not list((tmp_path / "other").rglob("*.json"))
    found = ResultsDirectory(tmp_path / "out" / "downstream").read_all()
    assert [each["cell"]["method"] for each in found] == ["asp-only", "idle"]
    assert table(TRIALS[:2], Source("panda-cube@champion", "no registry here", tmp_path / "elsewhere"), tmp_path)


class TestBadInput:
    def refused(self, words, trials, source, tmp_path):
        def never(*arguments):
            raise AssertionError("ran")

        before = {file: file.read_bytes() for file in (tmp_path / "out").rglob("*") if file.is_file()}
        with pytest.raises(TandemError, match=words) as caught:
            table(trials, source, tmp_path, never)
        assert "\n" not in str(caught.value)
        assert {file: file.read_bytes() for file in (tmp_path / "out").rglob("*") if file.is_file()} == before

    @pytest.fixture
    def file(self, source, tmp_path):
        table(TRIALS[:1], source, tmp_path)
        return tmp_path / "out" / "downstream" / "push-idle-0.json"

    def test_another_version(self, file, source, tmp_path):
        file.write_text(json.dumps({**json.loads(file.read_text()), "format_version": 9}))
        self.refused(r"push-idle-0\.json: format version 9, this program reads 1", TRIALS, source, tmp_path)

    def test_another_version_of_a_cell_that_is_not_asked_for(self, file, source, tmp_path):
        file.write_text(json.dumps({**json.loads(file.read_text()), "format_version": 9}))
        self.refused(r"push-idle-0\.json: format version 9", TRIALS[3:], source, tmp_path)

    def test_other_settings(self, file, source, tmp_path):
        trials = [small_trial("idle", num_episodes=9)]
        self.refused(r"push-idle-0\.json is of num_episodes 6, not 9", trials, source, tmp_path)

    def test_another_version_of_a_task(self, source, tmp_path):
        """A file that says nothing is of version 0, and refused."""
        old, today = [small_trial("idle", task) for task in ("box", "wall")]
        table([old, today], source, tmp_path)
        path = tmp_path / "out" / "downstream" / "box-idle-0.json"
        tree = json.loads(path.read_text())
        del tree["cell"]["task_version"]
        path.write_text(json.dumps(tree))
        self.refused(r"box-idle-0\.json is of task_version 0, not 1", [old], source, tmp_path)
        assert table([today], source, tmp_path, counted(ran := []))
        assert ran == []

    @pytest.fixture
    def played(self, source, tmp_path):
        table(TRIALS[1:2], source, tmp_path)
        return tmp_path / "out" / "downstream" / "push-asp-only-0.json"

    def test_other_primitives(self, played, source, tmp_path):
        tree = json.loads(played.read_text())
        tree["primitives"]["digest"] = "0" * 64
        played.write_text(json.dumps(tree))
        self.refused(r"push-asp-only-0\.json is of primitives\.digest '000", TRIALS, source, tmp_path)

    def test_seeds_of_other_settings(self, file, source, tmp_path):
        trials = [small_trial("idle", seed=1, num_episodes=9)]
        words = r"push-idle-0\.json and push-idle-1, asked for, are seeds of one method, but of num_episodes 6, not 9"
        self.refused(words, trials, source, tmp_path)

    def test_other_primitives_of_a_cell_that_is_not_asked_for(self, played, source, tmp_path):
        tree = json.loads(played.read_text())
        tree["primitives"]["name"] = "panda-cube@3"
        played.write_text(json.dumps(tree))
        words = r"push-asp-only-0\.json is of primitives\.name 'panda-cube@3', not"
        self.refused(words, TRIALS[3:], source, tmp_path)

    def test_another_seed_may_have_other_primitives(self, played, source, tmp_path):
        tree = json.loads(played.read_text())
        tree["primitives"] = {"name": "panda-cube@3", "digest": "0" * 64, "env_steps": 1e7}
        played.write_text(json.dumps(tree))
        assert table([small_trial("asp-only", seed=1)], source, tmp_path)
        self.refused("push-asp-only-0", [small_trial("asp-only", "box", seed=0)], source, tmp_path)

    def test_another_world(self, file, source, tmp_path):
        tree = json.loads(file.read_text())
        tree["world"]["friction"] = 0.5
        file.write_text(json.dumps(tree))
        self.refused(r"push-idle-0\.json is of world\.friction 0\.5, not 1\.0", TRIALS[2:], source, tmp_path)

    def test_a_training_directory_of_other_settings(self, source, tmp_path):
        table([small_trial("idle", "box", num_episodes=9)], source, tmp_path)
        ran = []
        with pytest.raises(TandemError, match=r"num_episodes 9, not 6.* of a table --runs"):
            make_table(TRIALS, source, tmp_path / "other", counted(ran), Callbacks())
        assert ran == []

    def test_no_json(self, file, source, tmp_path):
        file.write_text("{")
        self.refused(r"push-idle-0\.json is no JSON", TRIALS, source, tmp_path)


def result(method, task, seed, last, num=100):
    evaluation = {"num_episodes": num, "success_last": last}
    return {"cell": {"method": method, "task": task, "seed": seed}, "evaluation": evaluation}


def test_seeds_of_a_method_on_a_task_by_hand():
    results = [result("ours", "wall", seed, rate) for seed, rate in ((2, 0.84), (0, 0.80), (1, 0.82))]
    found = by_method_and_task([*results, result("ours", "box", 0, 0.96), result("idle", "wall", 0, 0.0)])
    assert [each["cell"]["seed"] for each in found["ours", "wall"]] == [0, 1, 2]
    # 0.82 +- 4.303 * 0.02 / sqrt(3)
    assert str(rate_of(found["ours", "wall"])) == "82.0 % [77, 87] (3)"
    # a single seed: 96 of 100, Wilson (z = 1.96) is 0.902 to 0.984
    assert str(rate_of(found["ours", "box"])) == "96.0 % [90, 98]* (1)"
    assert len(found) == 3


def test_intervals_by_hand():
    assert seed_interval([0.80, 0.82, 0.84]) == pytest.approx(
        (0.82 - 4.303 * 0.02 / 3**0.5, 0.82 + 4.303 * 0.02 / 3**0.5)
    )
    assert seed_interval([0.0, 0.5, 1.0]) == (0.0, 1.0)
    assert seed_interval([0.5, 0.5]) == (0.5, 0.5)
    # four: Student's t of three degrees of freedom is 3.182, the standard error 0.11547 / 2
    assert seed_interval([0.4, 0.6] * 2) == pytest.approx((0.5 - 3.182 * 0.057735, 0.5 + 3.182 * 0.057735), abs=1e-5)
    assert seed_interval([0.0, 1.0] * 8) == pytest.approx((0.5 - 1.96 * 0.516398 / 4, 0.5 + 1.96 * 0.516398 / 4))
