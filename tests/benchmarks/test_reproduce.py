"""One command for every learning experiment: what it would run, in which order, and what becomes of failures."""

import sys
from itertools import pairwise

import typer

from benchmarks.reproduce import SKILL_ENV_STEPS, Experiment, experiments, run_all
from benchmarks.trials import trial_config
from service.cli.main import app
from service.config import load_config
from service.config.recipes import recipes
from service.config.task_methods import TASK_METHODS
from service.envs.tasks import PAPERS


def test_every_method_is_run_on_every_task_with_three_seeds(tmp_path):
    everything = list(experiments(tmp_path))
    names = [each.name for each in everything]
    assert len(set(names)) == len(names) == len({each.file for each in everything})
    methods = [method for method in TASK_METHODS if not method.startswith(("csf", "any-", "ours-residual"))]
    cells = {f"downstream/{task}-{method}-{seed}" for task in PAPERS for method in methods for seed in range(3)}
    cells |= {f"downstream/push-ours-residual-her-{seed}" for seed in range(3)}
    assert cells <= set(names)


def test_every_command_is_accepted_by_its_program(tmp_path):
    """Commands are parsed, and the configurations that they stand for are made."""
    main = typer.main.get_command(app)
    for each in experiments(tmp_path):
        for _, _, module, *words in each.commands:
            if module == "benchmarks.trials":
                task, method, seed = words[:3]
                settings = [value for option, value in pairwise(words) if option == "--set"]
                config = trial_config(task, method, int(seed), "panda-cube@1", settings)
                assert (config.run.num_threads, config.run.final_episodes) == (1, 1000)
            elif module == "service":
                command = main.commands[words[0]]
                given = command.make_context("tandem", words[1:]).params
                config = load_config(recipes()[given["what"]], given["overrides"])
                assert config.run.total_env_steps == SKILL_ENV_STEPS


def making(tmp_path, name, *, needs=None, code=0):
    """An experiment that writes its name, unless it fails."""
    program = f"import pathlib, sys; {code} or pathlib.Path({str(tmp_path / name)!r}).touch(); sys.exit({code})"
    return Experiment(name, tmp_path / name, "", name, 0, [(sys.executable, "-c", program)], needs)


def test_one_waits_for_what_it_needs_and_failures_are_named(tmp_path):
    second = making(tmp_path, "second", needs=tmp_path / "first")
    bad = making(tmp_path, "bad", code=3)
    never = making(tmp_path, "never", needs=tmp_path / "bad")
    failed = run_all([second, never, bad, making(tmp_path, "first")], 2, tmp_path / "logs")
    assert sorted(failed) == ["bad", "never"]
    assert (tmp_path / "second").exists()
    assert sorted(path.stem for path in (tmp_path / "logs").iterdir()) == ["bad", "first", "second"]
