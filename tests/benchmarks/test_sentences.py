"""What the README would say of other results than those that are recorded."""

import pytest

from benchmarks.report.sentences import ahead_words, longer_words, without_hindsight_words


def trial(method, task, seed, last, curve=()):
    points = [{"env_steps": step, "success_last": rate} for step, rate in curve]
    return {
        "cell": {"method": method, "task": task, "seed": seed},
        "curve": points,
        "env_steps": points[-1]["env_steps"] if points else 0,
        "evaluation": {"success_last": last, "num_episodes": 1000},
    }


def curve(*rates):
    return list(zip((12_800, 25_600, 38_400, 51_200), rates, strict=True))


@pytest.mark.parametrize(
    ("last", "end"), [(0.66, "it is 1 point ahead"), (0.648, "they are level"), (0.61, "it is 4 points behind")]
)
def test_when_composing_is_last_ahead_by_hand(last, end):
    results = [
        trial("ours-her", "push", 0, last, curve(0.1, 0.7, 0.8, 0.9)),
        trial("ours-her", "push", 1, last, curve(0.1, 0.3, 0.4, 0.9)),  # means .1, .5, .6, .9
        trial("scratch-mcp", "push", 0, 0.3, curve(0.3, 0.2, 0.0, 0.0)),
        trial("scratch-mcp-her", "push", 0, 0.65, curve(0.0, 0.1, 0.55, 0.86)),  # ahead by .3 and .05, then by less
        trial("asp-only", "push", 0, 1.0),
    ]
    assert ahead_words(results, "ours-her", "push") == (
        "On *Push* composing is last ahead of learning from nothing by 5 points or more at 38,000 env steps. "
        f"At the end {end}."
    )


def test_composing_that_is_never_ahead_is_said_so():
    results = [
        trial("ours", "box", 0, 0.2, curve(0.0, 0.1, 0.2, 0.2)),
        trial("scratch-mcp", "box", 0, 0.9, curve(0.0, 0.1, 0.2, 0.9)),
    ]
    words = ahead_words(results, "ours", "box")
    assert "never 5 points or more ahead of learning from nothing; at the end it is 70 points behind." in words
    assert ahead_words(results[:1], "ours", "box") == ahead_words(results, "ours", "push") == ""


def test_where_learning_from_nothing_becomes_good_is_of_the_first_method_that_does():
    longer = [
        trial("scratch-mcp-her", "inair", 0, 1.0, curve(0.0, 0.0, 0.9, 1.0)),
        trial("scratch-monolithic-her", "inair", 0, 1.0, curve(0.0, 0.95, 0.95, 1.0)),
        trial("scratch-mcp-her", "push", 0, 0.89, curve(0.0, 0.1, 0.9, 0.89)),  # .895 as the mean of two
        trial("ours", "box", 0, 1.0, curve(1.0, 1.0, 1.0, 1.0)),
    ]
    many = [trial("scratch-mcp-her", "sphere", seed, 1.0, curve(0.9, 0.9, 0.9, 0.9)) for seed in (0, 1)]
    assert longer_words(longer, many) == (
        "In trials of 0.0512 M env steps learning from nothing reaches 90 %: without MCP, with 8 updates for 64 env "
        "steps, *InAir* after 0.0384 M (1 seed);\nwith MCP and 32 updates for 64 env steps, *Sphere* after 0.0256 M "
        "(2 seeds)."
    )
    assert longer_words(longer[2:], []) == ""


def test_learning_without_hindsight_is_beside_doing_nothing():
    results = [trial("idle", "push", 0, 0.05), trial("idle", "box", 0, 0.0)]
    results += [trial("scratch-mcp", "push", seed, rate) for seed, rate in enumerate((0.07, 0.08, 0.09))]
    results += [trial("scratch-monolithic", "box", 0, 0.001), trial("scratch-mcp-her", "box", 0, 0.9)]
    results += [trial("scratch-mcp", "wall", 0, 0.5)]  # doing nothing was not measured there
    assert without_hindsight_words(results) == (
        "Without hindsight learning from nothing is at most 3.0 points above doing nothing (1 to 3 seeds)."
    )
    assert without_hindsight_words(results[:2]) == ""
