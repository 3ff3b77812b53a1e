"""The few words about the whole, by hand."""

from benchmarks.report.summary import controls_words, headline_table


def trial(method, task, seed, rate):
    return {"cell": {"method": method, "task": task, "seed": seed}, "evaluation": {"success_last": rate}}


def test_rows_by_hand():
    results = [trial("ours-her", "push", seed, rate) for seed, rate in enumerate((0.90, 0.92, 0.97))]
    results += [trial("ours", "push", 0, 1.0), trial("asp-only", "inair", 0, 0.99)]
    results += [trial("scratch-mcp", "box", 0, 0.31), trial("scratch-mcp-her", "box", 0, 0.2)]
    results += [trial("scratch-mcp-her", "box", 1, 0.3), trial("scratch-mcp-her", "wall", 0, 0.5)]
    results += [trial("idle", "wall", 0, 0.9)]
    lines = headline_table(results).splitlines()
    assert lines[0] == "|  | Larger | InAir | Push | Sphere | Wall | Box |"
    assert lines[2:] == [
        "| composing frozen primitives, with hindsight |  |  | 93 % |  |  |  |",
        "| Bob alone, no downstream step |  | 99 % |  |  |  |  |",
        "| learned from nothing, the best of up to 2 on each task |  |  |  |  | 50 % | 31 % |",
        "| *the best of the paper* | *94 %* | *100 %* | *92 %* | *100 %* | *98 %* | *98 %* |",
    ]
    (only,) = [line for line in headline_table(results[:6]).splitlines() if "nothing" in line]
    assert only == "| learned from nothing: scratch MCP |  |  |  |  |  | 31 % |"


def control(name, seed, mixed):
    rows = [("idle", "mixed", 0.02), ("bob", "air", 0.1), ("bob", "mixed", mixed)]
    evaluations = [{"policy": policy, "goals": goals, "success_last": rate} for policy, goals, rate in rows]
    return {"control": name, "config": {"seed": seed}, "bob_env_steps": 6_040_000, "evaluations": evaluations}


def test_the_sentence_on_self_play_by_hand():
    runs = [control("ours", 0, 0.97), control("ours", 2, 0.98), control("table", 0, 0.5), control("uniform", 0, 0.125)]
    assert controls_words(runs) == (
        "After 6.0 million env steps of his own Bob solves 97.5 % (2) of random goals with those that Alice proposes, "
        "12.5 % (1) with uniform goals without her, 50.0 % (1) with uniform goals on the table without her "
        "(mean, and in brackets the number of seeds; [all controls](docs/results/skills.md))."
    )
