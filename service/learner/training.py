"""The inner loop of an update: epochs of minibatches, early stop of the policy, non-finite steps skipped."""

from __future__ import annotations

import math
from collections import defaultdict
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor
from torch.nn.utils import clip_grad_norm_

from service.config import ABCConfig
from service.learner import losses
from service.learner.minibatches import epoch
from service.learner.player import Player
from service.learner.samples import Cloning, Samples
from service.policies import gaussian

MAX_NON_FINITE = 3
"""So many minibatches with a loss or gradient that is not finite end an update."""
KL_STOP = 1.5
"""The policy stops once an epoch's mean KL passes this multiple of the target."""

Terms = dict[str, Tensor]


@dataclass(slots=True)
class Tally:
    """What happened in an update so far."""

    terms: defaultdict[str, list[Tensor]] = field(default_factory=lambda: defaultdict(list))
    """Of each minibatch that was learned from."""
    kls: list[float] = field(default_factory=list)
    """Of this epoch's minibatches."""
    num_non_finite: int = 0
    stopped: bool = False
    """The policy is done; the value network goes on."""

    @property
    def aborted(self) -> bool:
        """Too many minibatches were not finite."""
        return self.num_non_finite >= MAX_NON_FINITE

    def passes(self, kl: float, bound: float) -> bool:
        """Count a minibatch's KL; whether the epoch's mean is now above ``bound``."""
        if math.isfinite(kl):
            self.kls.append(kl)
        return bool(self.kls) and sum(self.kls) / len(self.kls) > bound

    def add(self, terms: Terms) -> None:
        """Count a minibatch that was learned from."""
        for name, value in terms.items():
            self.terms[name].append(value.detach())

    def means(self) -> dict[str, float]:
        """Each term's mean over the minibatches."""
        return {name: float(torch.stack(values).mean()) for name, values in self.terms.items()}


def train(
    player: Player, samples: Samples | None, cloning: Cloning | None, abc: ABCConfig, rng: np.random.Generator
) -> Tally:
    """Take a player's gradient steps of one update, until its epochs are over or three minibatches were not finite."""
    tally = Tally()
    for _ in range(player.config.num_epochs):
        tally.kls.clear()
        for minibatch in epoch(samples, cloning, player.config.minibatch_size, rng):
            _step(player, *minibatch, abc, tally)
            if tally.aborted:
                return tally
    return tally


def _step(player: Player, samples: Samples | None, cloning: Cloning | None, abc: ABCConfig, tally: Tally) -> None:
    """One gradient step, or none if it would not be finite."""
    config, parts, terms = player.config, [], Terms()
    if not tally.stopped:
        loss, policy_terms = _policy_loss(player, samples, cloning, abc)
        if samples is not None:
            tally.stopped = tally.passes(float(policy_terms["kl"]), KL_STOP * config.target_kl)
        if not tally.stopped:
            parts.append(loss)
            terms |= policy_terms
    if samples is not None:
        value_loss = losses.value_loss(player.value(samples.value_observation), samples.target)
        parts.append(config.value_weight * value_loss)
        terms["value_loss"] = value_loss
    total = torch.stack(parts).sum()
    player.optimizer.zero_grad()
    total.backward()
    norm = clip_grad_norm_(player.policy_parameters, config.max_grad_norm)
    value_norm = clip_grad_norm_(player.value_parameters, config.max_grad_norm)
    if not math.isfinite(float(total.detach() + norm + value_norm)):
        tally.num_non_finite += 1
        return
    player.optimizer.step()
    tally.add(terms if tally.stopped else terms | {"grad_norm": norm})


def _policy_loss(
    player: Player, samples: Samples | None, cloning: Cloning | None, abc: ABCConfig
) -> tuple[Tensor, Terms]:
    """PPO's surrogate, entropy bonus and cloning, of one pass through the policy."""
    rows = [part for part in (samples, cloning) if part is not None]
    action = torch.cat([part.action for part in rows])
    mean, std = player.policy(torch.cat([part.observation for part in rows]))
    num_samples = 0 if samples is None else len(samples)
    # Alice's noise is not part of what she demonstrates: her actions pull Bob's mean, and leave his std to PPO.
    learned_std = torch.cat((std[:num_samples], std[num_samples:].detach())) if abc.mean_only else std
    log_prob = gaussian.log_prob(action, mean, learned_std)
    loss, terms = log_prob.new_zeros(()), Terms()
    if samples is not None:
        config = player.config
        reference, advantage = samples.old_log_prob, samples.advantage
        if config.decoupled:
            # Clipping around the policy at the start of the update, and weighting by what it has moved since the one
            # that acted, keeps the whole clip range for this update (decoupled PPO, Hilton et al. 2022).
            reference = samples.start_log_prob
            advantage = advantage * losses.lag_weight(reference, samples.old_log_prob)
        pair = log_prob[:num_samples], reference
        surrogate, clip_fraction = losses.clipped_surrogate(*pair, advantage, config.clip, config.dual_clip)
        entropy = gaussian.entropy(std[:num_samples]).mean()
        loss = surrogate - config.entropy_weight * entropy
        terms = {"policy_loss": surrogate, "entropy": entropy, "clip_fraction": clip_fraction}
        # Exact: the usual estimate from sampled actions is ruled by the few that the policy would hardly have taken,
        # of which mirroring makes many.
        kl = gaussian.kl(samples.start_mean, samples.start_std, mean[:num_samples], std[:num_samples])
        terms["kl"] = kl.mean().detach()
    if cloning is not None:
        terms["cloning_loss"] = losses.cloning_loss(log_prob[num_samples:], cloning.old_log_prob, abc.clip)
        loss = loss + abc.weight * terms["cloning_loss"]
    return loss, terms
