"""The words on mutation testing, by hand."""

from benchmarks.report.measured import mutation_table, mutation_words

MACHINE = {"num_cpus": 2, "cpu": "a CPU", "git_commit": "0123456789", "time": "2026-11-25T10:00:00"}


def mutant(line, before, after, outcome="survived", file="sac/loop.py"):
    return {"file": f"service/{file}", "line": line, "diff": [f"-{before}", f"+{after}"], "outcome": outcome}


def test_survivors_that_behave_as_before_do_not_count():
    mutants = [mutant(1, "a = 1", "a = 2", "killed by tests/sac") for _ in range(17)]
    mutants += [
        mutant(2, "    num_threads: int = 0,", "    num_threads: int = 1,", file="actors/coverage.py"),
        mutant(3, "b = 1", "b = 2 | 1"),
    ]
    result = {"settings": {"packages": ["sac", "learner"]}, "mutants": mutants, "recorded": MACHINE}
    words = mutation_words(result)
    assert words.startswith("Of 19 mutants of sac, learner the tests notice 17. Of the 2 others 1 behave as before, ")
    assert "so 94.4 % of those that change behaviour" in words  # 17 of 18
    assert mutation_table(result).splitlines()[2:] == [
        "| actors/coverage.py:2 | `num_threads: int = 1,` | how many threads, not what they compute |",
        "| sac/loop.py:3 | `b = 2 \\| 1` | **no test** |",
    ]


def test_a_reason_is_of_one_file_and_of_the_changed_line():
    elsewhere = mutant(1, "num_threads: int = 0,", "num_threads: int = 1,")
    beside = mutant(2, "a = 1", "a = 2", file="actors/coverage.py")
    beside["diff"].append(" num_threads: int = 1,")
    gone = {**mutant(3, "", "", file="learner/transfer.py"), "diff": ["-", "-@torch.no_grad()", " def f():"]}
    words = [
        row.rpartition(" | ")[2] for row in mutation_table({"mutants": [elsewhere, beside, gone]}).splitlines()[2:]
    ]
    assert words == ["**no test** |", "**no test** |", "the tensors of a state_dict ask for no gradient |"]
