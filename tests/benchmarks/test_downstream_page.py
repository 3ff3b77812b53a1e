"""Parts of the page of downstream results that the recorded ones do not show."""

import pytest
from PIL import Image

from benchmarks.report.downstream import check_versions, draw_table, mean_until
from service.base.errors import TandemError
from service.envs.tasks import find_task


def result(method, task, seed, last, ever, curve=(), num=100):
    evaluation = {"num_episodes": num, "success_last": last, "success_ever": ever}
    return {
        "cell": {"method": method, "task": task, "seed": seed},
        "evaluation": evaluation,
        "primitives": {"name": "panda-cube@4", "digest": "ab" * 32, "env_steps": 1e7 + seed * 1e6},
        "made": {"git_commit": "c" * 40},
        "env_steps": 2000,
        "wall_s": 60.0,
        "curve": list(curve),
    }


def test_pictures_of_learning_have_a_panel_for_each_task(tmp_path):
    tasks, sizes = ("larger", "inair", "push", "hard-push", "hard-box"), []
    for num in (0, 3, 4):
        picture = draw_table([result("ours", name, 0, 0.5, 0.5) for name in tasks[:num]], tmp_path / f"{num}.png")
        with Image.open(picture) as image:
            sizes.append(image.size)
    assert sizes[0] == sizes[1]
    assert sizes[1][0] == sizes[2][0]
    assert sizes[2][1] > 1.5 * sizes[1][1]  # two rows of panels, not one


def test_results_of_another_version_of_a_task_are_refused():
    today = result("ours", "wall", 0, 0.5, 0.5)
    today["cell"]["task_version"] = 1
    check_versions([today])
    with pytest.raises(TandemError, match="another version"):
        check_versions([today, result("ours", "box", 0, 0.5, 0.5)])


def test_results_of_two_versions_of_what_learns_are_refused():
    old, new = result("ours", "push", 0, 0.5, 0.5), result("idle", "wall", 0, 0.5, 0.5)
    old["cell"]["task_version"], new["cell"]["task_version"] = find_task("push").version, find_task("wall").version
    new["made"] = {**new["made"], "learning_version": 2}
    check_versions([new])
    with pytest.raises(TandemError, match=r"ours on push was .* version 1 of what learns, idle on wall with version 2"):
        check_versions([new, old])


def test_how_soon_by_hand():
    curve = [{"env_steps": step, "success_last": rate} for step, rate in [(1, 0.9), (2, 0.1), (3, 0.8), (4, 0.9)]]
    assert mean_until([{"curve": curve}], 0.5) == 2  # of the two that are good enough on average, the last
    assert mean_until([{"curve": curve}], 0.6) == 4
    assert mean_until([{"curve": curve}], 0.9) is None
    assert mean_until([{"curve": curve}], 0.0) is None
