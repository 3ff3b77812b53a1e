"""The digest that recorded results and saved orchestrators name primitives and skills by."""

from __future__ import annotations

import hashlib
import operator
from collections.abc import Iterator

import numpy as np

from service.base.types import Array
from service.policies.frozen_skills import FrozenSkills
from service.policies.numpy_policy import NumpyPolicy


def parameters_digest(policy: NumpyPolicy | FrozenSkills) -> str:
    """SHA-256 of every array that a policy or skills act by: the same before and after they were used."""
    digest = hashlib.sha256()
    for name, array in sorted(_recorded(policy), key=operator.itemgetter(0)):
        digest.update(f"{name} {array.dtype} {array.shape} ".encode() + np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def _recorded(policy: NumpyPolicy | FrozenSkills) -> Iterator[tuple[str, Array]]:
    """Arrays by the names that they had when the first digests were recorded."""
    if not isinstance(policy, NumpyPolicy):
        for owner, layers in (("._actor._layers", policy.actor.network["layers"]), ("._network", policy.network)):
            for place, pair in enumerate(layers):
                yield from ((f"{owner}._layers.{place}.{number}", array) for number, array in enumerate(pair))
        return
    for name, array in policy.network.items():
        if not isinstance(array, list):  # of layers, which are there one by one, too
            plain = name.replace("primitives.hidden", "primitives.head").replace("weight_floor", "floor")
            parts = plain.replace("output_", "").split(".")
            path = "".join(f"._layers.{part}" if part.isdigit() else f"._{part}" for part in parts)
            yield path, array[:, None] if name == "primitives.output_bias" else array
