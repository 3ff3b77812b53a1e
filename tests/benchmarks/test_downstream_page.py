"""The page of downstream results, by hand."""

from PIL import Image

from benchmarks.report.downstream import BEST, PAPER, draw_table, steps_until, write_page


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


def test_the_page_by_hand():
    curve = [{"env_steps": 1000 * step, "success_last": rate} for step, rate in enumerate((0.0, 0.9, 0.4, 0.8, 0.9))]
    page = write_page(
        [result("ours", "wall", 1, 0.97, 1.0, curve), result("ours", "wall", 0, 0.95, 0.97, curve)], "picture.png"
    )
    lines = page.splitlines()
    # std 0.01414 of two seeds: 0.96 - 12.706 * 0.01414 / sqrt(2) is 0.833
    assert "| ours |  |  |  |  | 96.0 % [83, 100] (2) |  |" in lines
    assert "| *the paper's* | *83 %* | *100 %* | *52 %* | *100 %* | *98 %* | *98 %* |" in lines
    assert "| ours |  |  |  |  | 98.5 % [79, 100] (2) |  |" in lines
    assert "| ours |  |  |  |  | 95.0, 97.0 |  |" in lines
    assert "| ours |  |  |  |  | 10.5 M + 2, 1 min |  |" in lines
    assert "scratch" not in page


def test_harder_tasks_have_a_section_of_their_own():
    page = write_page([result("ours", "wall", 0, 0.96, 0.96)], "picture.png")
    assert "A harder start" not in page
    results = [
        result("ours", "wall", 0, 0.96, 0.96),
        result("ours", "hard-push", 0, 0.50, 0.75),
        result("asp-only", "hard-push", 0, 0.10, 0.10),
    ]
    for each in results:
        each["cell"]["task_version"] = 1
    page = write_page(results, "picture.png")
    plain, _, harder = page.partition("## A harder start and cube")
    assert "HardPush" not in plain
    assert r"| ours |  |  |  |  | 96.0 % [90, 98]\* (1) |  |" in plain.splitlines()
    # 50 of 100, Wilson (z = 1.96) is 0.404 to 0.596
    assert {"|  | HardPush |", r"| ours | 50.0 % [40, 60]\* (1) |", "| ours | 50.0 |"} <= set(harder.splitlines())
    assert "paper" not in harder


def test_pictures_of_learning_have_a_panel_for_each_task(tmp_path):
    tasks, sizes = ("larger", "inair", "push", "hard-push", "hard-box"), []
    for num in (0, 3, 4):
        picture = draw_table([result("ours", name, 0, 0.5, 0.5) for name in tasks[:num]], tmp_path / f"{num}.png")
        with Image.open(picture) as image:
            sizes.append(image.size)
    assert sizes[0] == sizes[1]
    assert sizes[1][0] == sizes[2][0]
    assert sizes[2][1] > 1.5 * sizes[1][1]  # two rows of panels, not one


def test_what_a_page_says_of_its_origin_by_hand():
    first, second = result("ours", "box", 0, 0.5, 0.5), result("idle", "box", 0, 0.0, 0.0)
    first["made"]["git_commit"] = "d" * 40 + "-dirty"
    second["primitives"] = None
    lines = write_page([first, second], "picture.png").splitlines()
    assert lines[-1] == f"Primitives: panda-cube@4 (abababababab). Commits: {'c' * 12}, {'d' * 12}-dirty."
    (old,) = [line for line in lines if "Recorded before" in line]
    assert old.startswith("Recorded before `tandem/Box-v1` (all methods), with other contacts")
    second["cell"]["task_version"] = 1
    assert "Recorded before `tandem/Box-v1` (ours)" in write_page([first, second], "picture.png")
    first["cell"]["task_version"] = 1
    assert "Recorded before" not in write_page([first, second], "picture.png")
    lines = write_page([first, second, result("ours", "wall", 0, 0.5, 0.5)], "picture.png").splitlines()
    (old,) = [line for line in lines if "Recorded before" in line]
    assert old.startswith("Recorded before `tandem/Wall-v1` (all methods), ")


def test_how_soon_beside_what_learns_from_nothing_by_hand():
    def learned(method, task, seed, last, *rates):
        points = [{"env_steps": 1000 * step, "success_last": rate} for step, rate in enumerate(rates, 1)]
        return result(method, task, seed, last, last, points)

    page = write_page(
        [
            learned("ours", "wall", 0, 0.9, 0.0, 0.9, 0.9),  # 0.9 x 0.8, the mean of the seeds: 3,000 env steps
            learned("ours", "wall", 1, 0.7, 0.1, 0.2, 0.3, 0.9, 0.7),  # 5,000
            learned("scratch-monolithic", "wall", 0, 0.3, 0.1, 0.3, 0.3),
            learned("scratch-monolithic-her", "wall", 0, 0.8, 0.1, 0.3, 0.5, 0.8, 0.8),  # 5,000
            learned("ours", "box", 0, 0.9, 0.0, 0.9, 0.9),
            learned("scratch-monolithic", "box", 0, 0.3, 0.1, 0.3, 0.3),  # never
            learned("ours", "push", 0, 0.9, 0.0, 0.9, 0.9),  # nothing to compare with
            learned("ours", "inair", 0, 0.9, 0.0, 0.8, 0.8),  # 0.81 is not held
            learned("scratch-monolithic", "larger", 0, 0.3, 0.1, 0.3, 0.3),
        ],
        "picture.png",
    )
    lines = page.splitlines()
    assert "| ours |  |  | 3 |  | 4 | 3 |" in lines
    assert "| *best from scratch* |  |  |  |  | *5, scratch monolithic + HER (2)* | *> 2 (1)* |" in lines


def test_how_soon_by_hand():
    curve = [{"env_steps": step, "success_last": rate} for step, rate in [(1, 0.9), (2, 0.1), (3, 0.8), (4, 0.9)]]
    assert steps_until(curve, 0.5) == 2  # of the two that are good enough on average, the last
    assert steps_until(curve, 0.6) == 4
    assert steps_until(curve, 0.9) is None
    assert steps_until(curve, 0.0) is None


def test_the_papers_rates():
    """Shares of 16 episodes of three seeds, to two digits: all but one."""
    of_48 = {round(num / 48, 2) for num in range(49)}
    rates = [rate for row in PAPER.values() for rate in row.values()]
    assert [rate for rate in rates if rate not in of_48] == [0.36]
    assert [len(row) for row in PAPER.values()] == [6] * 9
    assert dict(BEST) == {"larger": 0.94, "inair": 1.00, "push": 0.92, "sphere": 1.00, "wall": 0.98, "box": 0.98}
