"""The table of systems in four rows, by hand."""

from benchmarks.report.summary import headline_table


def trial(method, task, seed, rate):
    return {
        "cell": {"method": method, "task": task, "seed": seed},
        "evaluation": {"success_last": rate, "num_episodes": 100},
    }


def test_rows_by_hand():
    results = [trial("ours-her", "push", seed, rate) for seed, rate in enumerate((0.90, 0.92, 0.97))]
    results += [trial("ours", "push", 0, 1.0), trial("asp-only", "inair", 0, 0.99)]
    results += [trial("scratch-mcp", "box", 0, 0.31), trial("scratch-mcp-her", "box", 0, 0.2)]
    results += [trial("scratch-mcp-her", "box", 1, 0.3), trial("scratch-mcp-her", "wall", 0, 0.5)]
    results += [trial("idle", "wall", 0, 0.9)]
    lines = headline_table(results).splitlines()
    assert lines[0] == "|  | Larger | InAir | Push | Sphere | Wall | Box |"
    assert lines[2:] == [
        "| composing frozen primitives, with hindsight |  |  | 93 % (3) |  |  |  |",
        "| Bob alone, no downstream step |  | 99 % (1) |  |  |  |  |",
        "| learned from nothing, the best of up to 2 on each task |  |  |  |  | 50 % (1) | 31 % (1) |",
        "| *the best of the paper* | *94 % (3)* | *100 % (3)* | *92 % (3)* | *100 % (3)* | *98 % (3)* | *98 % (3)* |",
        "",
        "Success at the last step, the mean of the seeds; in brackets how many seeds.",
    ]
    (only,) = [line for line in headline_table(results[:6]).splitlines() if "nothing" in line]
    assert only == "| learned from nothing: scratch MCP |  |  |  |  |  | 31 % (1) |"
