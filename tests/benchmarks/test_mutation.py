"""The words on mutation testing, by hand."""

from benchmarks.report.mutation import mutation_table, mutation_words

MACHINE = {"num_cpus": 2, "cpu": "a CPU", "git_commit": "0123456789", "time": "2026-11-25T10:00:00"}


def mutant(line, before, after, outcome="survived"):
    return {"file": "service/sac/loop.py", "line": line, "diff": [f"-{before}", f"+{after}"], "outcome": outcome}


def test_survivors_that_behave_as_before_do_not_count():
    mutants = [mutant(1, "a = 1", "a = 2", "killed by tests/sac") for _ in range(17)]
    mutants += [
        mutant(2, "def f(num_threads: int = 0):", "def f(num_threads: int = 1):"),
        mutant(3, "b = 1", "b = 2 | 1"),
    ]
    result = {"settings": {"packages": ["sac", "learner"]}, "mutants": mutants, "recorded": MACHINE}
    words = mutation_words(result)
    assert words.startswith("Of 19 mutants of sac, learner the tests notice 17. Of the 2 others 1 behave as before, ")
    assert "so 94.4 % of those that change behaviour" in words  # 17 of 18
    assert mutation_table(result).splitlines()[2:] == [
        "| sac/loop.py:2 | `def f(num_threads: int = 1):` | how many threads, not what they compute |",
        "| sac/loop.py:3 | `b = 2 \\| 1` | **no test** |",
    ]
