"""Trials small enough for tests."""

from service.downstream.settings import make_trial

SMALL = {"num_worlds": 4, "gradient_steps": 2, "batch_size": 16, "learning_starts": 200, "hidden_sizes": (8,)}
SETS = [f"--set={key}={list(value) if isinstance(value, tuple) else value}" for key, value in SMALL.items()]


def small_trial(method="ours", task="push", **changes):
    """Three iterations of 200 env steps; the second and third learn."""
    values = {"num_env_steps": 600, "num_episodes": 6, "curve_every": 2, "curve_episodes": 4, **changes}
    return make_trial(task=task, method=method, sac=SMALL, **values)
