"""Networks that begin from trained ones: the same sizes, or inputs that are new or gone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from torch import nn

from service.base.types import Array
from service.envs.observations import Layouts

BOB_INPUTS = ("bob", "gate", "positions")
"""Inputs of Bob's policy, for ``take_over``."""


@torch.no_grad()
def take_over(
    network: nn.Module, given: Mapping[str, Array], before: Layouts, after: Layouts, inputs: Sequence[str]
) -> str:
    """Copy the parameters of a trained network of another layout, if all of them fit, or else none.

    An input that both layouts have keeps its weights and its normalisation. A new one gets weights of 0, so that the
    network computes what it did, and learns what it is good for. Bounds of the std and of weights are those of the new
    network's configuration.

    Args:
        network: that is new.
        given: parameters and buffers of the trained one, by name.
        before: layouts of the world of the trained one.
        after: layouts of the world of the new one.
        inputs: names in ``Layouts`` of all that goes into the network or a part of it; what it sees comes first.

    Returns:
        What was taken, in words.
    """
    if before.num_objects != after.num_objects:
        return f"not taken, it was trained in a world of {_objects(before)}, and this run has {_objects(after)}"
    if before.alike != after.alike:
        return f"not taken, objects {_numbers(before)} were alike where it was trained, here {_numbers(after)} are"
    for seen in inputs:
        old, new = getattr(before, seen), getattr(after, seen)
        if old.size == new.size and old.columns != new.columns:  # by their shapes the weights would fit
            return (
                f"not taken, its inputs are {', '.join(new.columns)}, those of the trained one {', '.join(old.columns)}"
            )
    own = network.state_dict()
    constants = {name for name, _ in network.named_buffers()}  # a learner's state has none
    if missing := sorted((own.keys() ^ given.keys()) - constants):
        return f"not taken, {len(missing)} parameters are not in both, such as {missing[0]}"
    fitted = {}
    for name, tensor in own.items():
        if name not in given or name.endswith("by_object") or not tensor.dim():  # of the layout, or the configuration
            continue
        array = torch.from_numpy(np.array(given[name], dtype=np.float32))
        if array.shape != tensor.shape:
            with_inputs = _with_inputs(array, tensor.clone(), name, before, after, inputs)
            if with_inputs is None:
                return f"not taken, {name} is of shape {list(given[name].shape)}, not {list(tensor.shape)}"
            array = with_inputs
        fitted[name] = array
    network.load_state_dict(own | fitted)
    saw, sees = (getattr(seen, inputs[0]).columns.keys() for seen in (before, after))
    new, gone = sorted(sees - saw), sorted(saw - sees)
    notes = [f"{word} {', '.join(names)}" for word, names in (("new", new), ("left out", gone)) if names]
    return f"taken{': ' if notes else ''}{'; '.join(notes)}"


def _objects(seen: Layouts) -> str:
    return f"{seen.num_objects} object{'s' * (seen.num_objects > 1)}"


def _numbers(seen: Layouts) -> str:
    return ", ".join(str(number + 1) for number in seen.alike) or "none"


def _with_inputs(
    trained: torch.Tensor, own: torch.Tensor, name: str, before: Layouts, after: Layouts, inputs: Sequence[str]
) -> torch.Tensor | None:
    """What is there of a tensor whose last axis is inputs; None where the last axis is none, or others differ."""
    for seen in inputs:
        old, new = getattr(before, seen), getattr(after, seen)
        if (trained.shape[-1], own.shape[-1]) == (old.size, new.size) and trained.shape[:-1] == own.shape[:-1]:
            if name.endswith("weight"):
                own.zero_()
            for entry in new.columns.keys() & old.columns.keys():
                own[..., new[entry]] = trained[..., old[entry]]
            return own
    return None
