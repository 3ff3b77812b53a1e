"""What a runner tells of its task generator."""

from __future__ import annotations

import numpy as np

from service.generator.generator import TaskGenerator
from service.store.models import GoalCell, GoalGrid


def goal_grid(generator: TaskGenerator, iteration: int, num_env_steps: int) -> GoalGrid:
    """The cells in which a valid goal was ever proposed, as they are after ``iteration`` iterations."""
    grid = generator.grid
    maps = grid.maps()
    seen = np.argwhere(maps["seen"])
    cells = tuple(
        GoalCell(
            center_m=tuple(np.round(maps["center"][tuple(at)], 4).tolist()),
            num_tries=int(maps["num_tries"][tuple(at)]),
            success_rate=round(float(maps["success_rate"][tuple(at)]), 4),
            learnability=round(float(maps["learnability"][tuple(at)]), 4),
        )
        for at in seen
    )
    lower, upper = grid.bounds_m
    return GoalGrid(
        iteration=iteration,
        num_env_steps=num_env_steps,
        cell_size_m=grid.cell_size_m,
        shape=grid.shape,
        num_cells=int(np.prod(grid.shape)),
        lower_m=lower,
        upper_m=upper,
        cells=cells,
    )
