"""Networks that begin from trained ones: the same sizes, or inputs that are new or gone."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from torch import nn

from service.base.types import Array
from service.envs.observations import GOAL_FROM_OBJECT, ObservationLayout


@torch.no_grad()
def take_over(
    network: nn.Module, given: Mapping[str, Array], before: ObservationLayout, after: ObservationLayout
) -> str:
    """Copy the parameters of a trained network of another layout, if all of them fit, or else none.

    An input that both layouts have keeps its weights and its normalisation. A new one gets weights of 0, so that the
    network computes what it did, and learns what it is good for.

    Args:
        network: that is new.
        given: parameters and buffers of the trained one, by name.
        before: layout of what the trained one sees.
        after: layout of what the new one sees.

    Returns:
        What was taken, in words.
    """
    if (there := _size(before, "object")) != (here := _size(after, "object")):
        return f"not taken, it was trained with {there // 3} objects, here is {here // 3}"
    own = network.state_dict()
    constants = {name for name, _ in network.named_buffers()}  # of the layout; a learner's state has none
    if missing := sorted((own.keys() ^ given.keys()) - constants):
        return f"not taken, {len(missing)} parameters are not in both, such as {missing[0]}"
    fitted = {}
    for name, tensor in own.items():
        if name not in given:
            continue
        array = torch.from_numpy(np.array(given[name], dtype=np.float32))
        if array.shape != tensor.shape:
            with_inputs = _with_inputs(array, tensor.clone(), name, before, after)
            if with_inputs is None:
                return f"not taken, {name} is of shape {list(given[name].shape)}, not {list(tensor.shape)}"
            array = with_inputs
        fitted[name] = array
    network.load_state_dict(own | fitted)
    new, gone = (sorted(one.columns.keys() - other.columns.keys()) for one, other in ((after, before), (before, after)))
    notes = [f"{word} {', '.join(names)}" for word, names in (("new", new), ("left out", gone)) if names]
    return f"taken{': ' if notes else ''}{'; '.join(notes)}"


def _with_inputs(
    trained: torch.Tensor, own: torch.Tensor, name: str, before: ObservationLayout, after: ObservationLayout
) -> torch.Tensor | None:
    """What is there of a tensor whose last axis is inputs; None where the last axis is none, or others differ."""
    for old, new in _inputs(before, after):
        if (trained.shape[-1], own.shape[-1]) == (old.size, new.size) and trained.shape[:-1] == own.shape[:-1]:
            if name.endswith("weight"):
                own.zero_()
            for entry in new.columns.keys() & old.columns.keys():
                own[..., new[entry]] = trained[..., old[entry]]
            return own
    return None


def _inputs(
    before: ObservationLayout, after: ObservationLayout
) -> tuple[tuple[ObservationLayout, ObservationLayout], ...]:
    """Layouts of all inputs that a policy or a value network has: the whole, its positions, and with the way to go."""
    pairs = [(before, after)]
    if "goal" in before.columns and "goal_from_object" not in before.columns:  # Bob's
        pairs.append((_with_way(before), _with_way(after)))
        pairs.append((before.without("goal"), after.without("goal")))
    return tuple(pairs)


def _size(layout: ObservationLayout, name: str) -> int:
    columns = layout[name]
    return int(columns.stop - columns.start)


def _with_way(layout: ObservationLayout) -> ObservationLayout:
    """A layout of Bob's, and the ways to the goals."""
    return layout + GOAL_FROM_OBJECT.of(_size(layout, "goal") // 3)
