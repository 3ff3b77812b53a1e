"""Learning of tasks that is small enough for tests."""

from service.config import parse_config

SMALL = {"num_worlds": 4, "gradient_steps": 2, "batch_size": 16, "learning_starts": 200, "hidden_sizes": (8,)}
RUN = {
    "total_env_steps": 600,
    "checkpoint_interval": 1,
    "evaluation_interval": 2,
    "evaluation_episodes": 4,
    "final_episodes": 6,
    "num_threads": 1,
}
SETS = [
    f"--set={group}.{key}={list(value) if isinstance(value, tuple) else value}"
    for group, keys in (("sac", SMALL), ("run", RUN))
    for key, value in keys.items()
]


def small_trial(method="ours", task="push", *, sac=None, run=None, **changes):
    """Three iterations of 200 env steps; the second and third learn."""
    tree = {"method": method, "task": task, "sac": SMALL | (sac or {}), "run": RUN | (run or {}), **changes}
    return parse_config(tree, where="a test")
