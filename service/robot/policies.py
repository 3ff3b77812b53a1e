"""Policies that a robot can be given."""

from __future__ import annotations

import numpy as np

from service.base.errors import TandemError
from service.envs.observations import ACTION, layouts
from service.methods.compose import check_robot
from service.registry.loading import Trained


def for_robot(trained: Trained) -> Trained:
    """The same in its nominal world, where it was trained in worlds that are drawn: a robot is one.

    Raises:
        TandemError: skills, a policy that composes nothing, or one of another robot or layout.
    """
    trained.expect("primitives", "orchestrator", by="tandem robot")
    if trained.kind == "orchestrator" and trained.trained is None:
        raise TandemError(f"{trained.label} acts without primitives; a bridge plays what composes them")
    check_robot(trained.trained or trained)
    found = trained.nominal
    if found.world.num_observed_obstacles:
        raise TandemError(f"{found.label} observes obstacles, and the bridge measures the object alone; train without")
    size = layouts(found.world).bob.size
    try:
        shape = found.player().act_deterministic(np.zeros((1, size), dtype=np.float32)).shape
    except ValueError as error:
        raise TandemError(f"{found.label} does not take {size} numbers, as the bridge measures them: {error}") from None
    if shape != (1, ACTION.size):
        raise TandemError(f"{found.label} acts by {shape[-1]} numbers; the bridge takes {ACTION.size}")
    return found
