"""How an epoch is cut into minibatches of samples and demonstrations."""

from __future__ import annotations

from typing import TypeVar

import numpy as np
import torch

from service.learner.samples import Cloning, Samples

Minibatch = tuple[Samples | None, Cloning | None]

Rows = TypeVar("Rows", Samples, Cloning)


def epoch(samples: Samples | None, cloning: Cloning | None, size: int, rng: np.random.Generator) -> list[Minibatch]:
    """Each sample once, in random order, beside demonstrations drawn from a shuffled permutation.

    Samples are cut into as many equal minibatches as bring them nearest to ``size``; demonstrations come in half that
    size, and are cycled through if they are too few. Demonstrations alone are gone through once.

    Args:
        samples: B of them, or None.
        cloning: D demonstrations, or None; not both None.
        size: of a minibatch of samples.
        rng: shuffles.
    """
    half = max(size // 2, 1)
    if samples is not None:
        num = max(round(len(samples) / size), 1)
    else:
        assert cloning is not None, "an epoch needs samples or demonstrations"
        num = max(round(len(cloning) / half), 1)
    own = [None] * num if samples is None else _draw(samples, len(samples), rng).split(num)
    drawn = [None] * num if cloning is None else _draw(cloning, num * min(half, len(cloning)), rng).split(num)
    return list(zip(own, drawn, strict=True))


def _draw(rows: Rows, num: int, rng: np.random.Generator) -> Rows:
    """``num`` rows in random order, none twice before each was drawn once."""
    rounds = [rng.permutation(len(rows)) for _ in range(-(-num // len(rows)))]
    indices = torch.from_numpy(np.concatenate(rounds)[:num])
    return rows.take(indices.to(rows.observation.device))
