"""The page that compares with the paper, by hand."""

from benchmarks.report.comparison import comparison_table, longer_table


def trial(method, task, seed, rate):
    return {
        "cell": {"method": method, "task": task, "seed": seed},
        "evaluation": {"success_last": rate, "num_episodes": 1000},
    }


def test_cells_by_hand():
    results = [trial("ours", "push", seed, rate) for seed, rate in enumerate((0.90, 0.92, 0.94))]
    results += [trial("ours", "larger", 0, 0.80), trial("asp-only", "push", 0, 0.0)]
    lines = comparison_table(results).splitlines()
    assert lines[0] == "|  | Larger | InAir | Push | Sphere | Wall | Box |"
    # Push: 0.92 +- 0.0497 of ours, 25 of 48 are 0.38 to 0.66; Larger: 0.77 to 0.82 of ours, 40 of 48 are 0.70 to 0.91
    ours = ["80.0 (83, -3)", "not run (100)", "**92.0 (52, +40)**", "not run (100)", "not run (98)", "not run (98)"]
    assert lines[2] == f"| ours | {' | '.join(ours)} |"
    # none of 1,000 is up to 0.00383, 1 of 48 from 0.00369 on: in common
    assert lines[6].startswith("| ASP only | not run (94) | not run (94) | 0.0 (2, -2) |")
    assert len(lines) == 2 + 9


def test_longer_trials_by_hand():
    results = [trial("ours", "push", seed, rate) for seed, rate in enumerate((0.90, 0.92))]
    results += [trial("idle", "push", 0, 0.5), trial("ours", "box", 0, 0.5)]
    longer = [trial("ours", "push", 1, 0.97), trial("ours", "inair", 0, 1.0), trial("asp-only", "inair", 0, 0.25)]
    lines = longer_table(results, longer).splitlines()
    assert [lines[0], *lines[2:]] == [
        "|  | InAir | Push |",
        "| ours | not run to 100.0 (1) | 91.0 to 97.0 (1) |",
        "| ASP only | not run to 25.0 (1) |  |",
    ]
