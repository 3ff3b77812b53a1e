"""PPO and Alice behavioural cloning for one player, from turns to new parameters: ``collect``, then ``update``.

Three policies meet in an update, with the names of decoupled PPO (Hilton et al. 2022). The behaviour policy acted. The
proximal policy is the one at the start of the update, which may be a version or two ahead. The third is being learned.

Shapes: T steps of a turn (time first), N worlds, B samples, D steps of demonstrations.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor
from torch.nn.utils import clip_grad_norm_

from service.actors.rollout import Turns
from service.base.liveness import count_work
from service.base.types import Array, Metrics
from service.config.self_play import CloningConfig
from service.learner.diagnostics import cloning_metrics, explained_variance, mean_and_std, probes
from service.learner.player import LEARNING_RATE_BOUNDS, Player
from service.learner.samples import Cloning, DemonstrationRows, Samples, draw_epoch
from service.policies import gaussian

Scalars = dict[str, Tensor]

MAX_IMPORTANCE_WEIGHT = 2.0
"""Bound on the variance of importance weights, at the price of a little bias."""
MAX_NON_FINITE = 3
"""Number of minibatches with a loss or gradient that is not finite, after which an update ends."""
KL_STOP = 1.5
"""The policy stops learning once an epoch's mean KL passes this multiple of the target."""
KL_COLLAPSE = 10.0
"""An update that moved the policy by more than this multiple of the target KL is undone."""
LEARNING_RATE_STEP = 1.5
"""The KL-adaptive learning rate moves by this factor (rsl_rl)."""


def collect(played: Sequence[Turns], player: Player) -> Samples | None:
    """Turn what was played into samples: the active steps of all worlds that ``learn``.

    Args:
        played: turns of one player, with equal T; joined along worlds.
        player: values the states, and is the proximal policy.

    Returns:
        The samples, None if there are none.
    """
    active = _join(played, "active")
    if not active.any():
        return None

    def tensor(array: Array) -> Tensor:
        return torch.from_numpy(array).to(player.device)

    names = "observation", "value_observation", "action", "log_prob"
    observation, value_observation, action, log_prob = (tensor(_join(played, name)[active]) for name in names)
    reward, terminated, acted = tensor(_join(played, "reward")), tensor(_join(played, "terminated")), tensor(active)
    final = tensor(np.concatenate([each.final_value_observation[each.learn] for each in played]))
    with torch.no_grad():
        estimates = player.value(torch.cat((value_observation, final)))
        proximal_mean, proximal_std = player.policy(observation)
    value, final_value = estimates[: len(action)], estimates[len(action) :]
    values, config = torch.zeros_like(reward).masked_scatter_(acted, value), player.config
    estimated = reward, values, final_value, acted, terminated
    advantage = advantages(*estimated, gamma=config.gamma, gae_lambda=config.gae_lambda)[acted]
    wide = advantage.double()
    mean, std = mean_and_std(wide)
    return Samples(
        observation=observation,
        value_observation=value_observation,
        action=action,
        behaviour_log_prob=log_prob,
        proximal_mean=proximal_mean,
        proximal_std=proximal_std,
        advantage=((wide - mean) / (std + 1e-8)).float(),
        value_target=advantage + value,
        value=value,
    )


def advantages(
    rewards: Tensor,
    values: Tensor,
    final_values: Tensor,
    active: Tensor,
    terminated: Tensor,
    *,
    gamma: float,
    gae_lambda: float,
) -> Tensor:
    """Estimate advantages by GAE (Schulman et al. 2016, eq. 16), for turns of unequal length.

    ``A_t = d_t + gamma lambda A_{t+1}`` with ``d_t = r_t + gamma V_{t+1} - V_t``. Behind the last active step, ``A`` is
    0 and ``V`` the final value: a turn that ran out of time is bootstrapped (Pardo et al. 2018). Behind a terminated
    step both are 0.

    Args:
        rewards: (T, N).
        values: (T, N) at the states the actions were taken in; ignored where not active.
        final_values: (N,) of the state behind each world's last active step; ignored where that step terminated.
        active: (T, N) true up to each turn's last step, false after it.
        terminated: (T, N) the turn truly ended with this step.
        gamma: discount.
        gae_lambda: decay of the multi-step estimates.

    Returns:
        Advantages (T, N), zero where not active; ``advantages + values`` are the value targets.
    """
    result = torch.zeros_like(rewards)
    discounts = gamma * terminated.logical_not()
    next_value, next_advantage = final_values, torch.zeros_like(final_values)
    for step in reversed(range(len(rewards))):
        error = rewards[step] + discounts[step] * next_value - values[step]
        advantage = error + discounts[step] * gae_lambda * next_advantage
        result[step] = next_advantage = torch.where(active[step], advantage, 0.0)
        next_value = torch.where(active[step], values[step], next_value)
    return result


def update(
    player: Player,
    samples: Samples | None,
    demonstrations: DemonstrationRows | None,
    how: CloningConfig,
    rng: np.random.Generator,
    *,
    version: int = 0,
) -> Metrics:
    """Learn from samples, demonstrations or both; go back to the parameters before if that fails.

    In the first updates the value network alone may learn; ``version`` is the number of those before this one.

    An update fails when three minibatches were not finite, or when it moved the policy by ten times the target KL.
    The KL is exact, between the policies before and after, averaged over probes.

    Returns:
        Metrics without the player's prefix; one that there is nothing to measure on is left out.
    """
    metrics = {"learning_rate": player.optimizer.learning_rate, "non_finite_steps": 0.0, "rollbacks": 0.0}
    policy_learns = version >= player.config.value_first_updates
    if not policy_learns:
        demonstrations = None
    rows = samples if samples is not None else demonstrations
    if rows is None:
        return metrics
    saved, probed = player.state(), rows.take(probes(len(rows)))
    with torch.no_grad():
        before = player.policy(probed.observation)
    stats = train(player, samples, demonstrations, how, rng, policy_learns=policy_learns)
    with torch.no_grad():
        kl = float(gaussian.kl(*before, *player.policy(probed.observation)).mean())
    failed = stats.aborted or not kl <= KL_COLLAPSE * player.config.target_kl
    if failed:
        player.load_state(saved)
    if policy_learns:
        rate = _adapted_learning_rate(player, math.inf if failed or stats.stopped else kl)
        player.optimizer.learning_rate = min(rate, _highest_learning_rate(player, version))
    if samples is not None:
        metrics["explained_variance"] = explained_variance(samples.value_target, samples.value)
    metrics |= {"non_finite_steps": float(stats.num_non_finite), "rollbacks": float(failed)}
    metrics["policy_steps"] = float(max(len(stats.scalars.get(name, ())) for name in ("policy_loss", "cloning_loss")))
    if stats.cloned is not None:
        metrics |= cloning_metrics(player, stats.cloned)
    means = {name: float(torch.stack(values).mean()) for name, values in stats.scalars.items()}
    return metrics | means | {"kl": kl}


@dataclass(slots=True)
class UpdateStats:
    """Record of an update so far."""

    scalars: defaultdict[str, list[Tensor]] = field(default_factory=lambda: defaultdict(list))
    """Losses and what else is measured, by name; one of each minibatch that was learned from."""
    kls: list[float] = field(default_factory=list)
    """KLs of this epoch's minibatches."""
    num_non_finite: int = 0
    stopped: bool = False
    """The policy is done; the value network goes on."""
    cloned: Cloning | None = None
    """Some of the demonstrations that were drawn."""

    @property
    def aborted(self) -> bool:
        """Whether too many minibatches were not finite."""
        return self.num_non_finite >= MAX_NON_FINITE

    def passes(self, kl: float, bound: float) -> bool:
        """Count a minibatch's KL; return whether the epoch's mean is now above ``bound``."""
        if math.isfinite(kl):
            self.kls.append(kl)
        return bool(self.kls) and sum(self.kls) / len(self.kls) > bound


def train(
    player: Player,
    samples: Samples | None,
    demonstrations: DemonstrationRows | None,
    how: CloningConfig,
    rng: np.random.Generator,
    *,
    policy_learns: bool = True,
) -> UpdateStats:
    """Take a player's gradient steps of one update, until its epochs are over or three minibatches were not finite.

    All epochs are drawn first: only demonstrations that are drawn need a log-probability under the policy before.
    """
    stats, config = UpdateStats(stopped=not policy_learns), player.config
    num_samples, num_demonstrations = (0 if rows is None else len(rows) for rows in (samples, demonstrations))
    epochs = [draw_epoch(num_samples, num_demonstrations, config, how, rng) for _ in range(config.num_epochs)]
    cloning = None
    if demonstrations is not None:
        drawn = np.unique(np.concatenate([places for epoch in epochs for _, places in epoch]))
        cloning = demonstrations.to_clone(drawn, player)
        stats.cloned = cloning.take(probes(len(cloning)))
    for epoch in epochs:
        stats.kls.clear()
        for own, cloned in epoch:
            drawn_samples = None if samples is None else samples.take(own)
            drawn_cloning = None if cloning is None else cloning.take(np.searchsorted(drawn, cloned))
            _step(player, drawn_samples, drawn_cloning, how, stats)
            count_work()
            if stats.aborted:
                return stats
    return stats


def _step(
    player: Player, samples: Samples | None, cloning: Cloning | None, how: CloningConfig, stats: UpdateStats
) -> None:
    """Take one gradient step, or none if it would not be finite; a policy that is to stop by now is left out of it."""
    config, scalars, losses = player.config, Scalars(), []
    if not stats.stopped:
        policy_loss, of_policy = _policy_loss(player, samples, cloning, how)
        if samples is not None:
            stats.stopped = stats.passes(float(of_policy["kl"]), KL_STOP * config.target_kl)
        if not stats.stopped:
            losses, scalars = [policy_loss], of_policy
    if samples is not None:
        scalars["value_loss"] = value_loss(player.value(samples.value_observation), samples.value_target)
        losses.append(scalars["value_loss"])
    loss = torch.stack(losses).sum()
    player.policy.zero_grad()
    player.value.zero_grad()
    loss.backward()
    norm = clip_grad_norm_(player.policy_parameters, config.max_grad_norm)
    value_norm = clip_grad_norm_(player.value_parameters, config.max_grad_norm)
    if not math.isfinite(float(loss.detach() + norm + value_norm)):
        stats.num_non_finite += 1
        return
    player.optimizer.step()
    if not stats.stopped:
        scalars["grad_norm"] = norm
    for name, value in scalars.items():
        stats.scalars[name].append(value.detach())


def _policy_loss(
    player: Player, samples: Samples | None, cloning: Cloning | None, how: CloningConfig
) -> tuple[Tensor, Scalars]:
    """PPO's surrogate, entropy bonus and cloning, of one pass through the policy."""
    rows = [part for part in (samples, cloning) if part is not None]
    action = torch.cat([part.action for part in rows])
    mean, std = player.policy(torch.cat([part.observation for part in rows]))
    num_samples = 0 if samples is None else len(samples)
    # A demonstrator's noise is not part of what is shown: the actions pull the mean, and leave the std to PPO.
    learned_std = torch.cat((std[:num_samples], std[num_samples:].detach())) if how.mean_only else std
    log_prob = gaussian.log_prob(action, mean, learned_std)
    loss, scalars = log_prob.new_zeros(()), Scalars()
    if samples is not None:
        config = player.config
        reference, advantage = samples.behaviour_log_prob, samples.advantage
        if config.decoupled:
            # Clipping around the proximal policy, and weighting by what it has moved since the one that acted, keeps
            # the whole clip range for this update.
            reference = samples.proximal_log_prob
            advantage = advantage * importance_weight(reference, samples.behaviour_log_prob)
        pair = log_prob[:num_samples], reference
        surrogate, clip_fraction = clipped_surrogate(*pair, advantage, config.clip, config.dual_clip)
        entropy = gaussian.entropy(std[:num_samples]).mean()
        loss = surrogate - config.entropy_weight * entropy
        scalars = {"policy_loss": surrogate, "entropy": entropy, "clip_fraction": clip_fraction}
        # Exact: the usual estimate from sampled actions is ruled by the few that the policy would hardly have taken,
        # of which symmetry augmentation makes many.
        kl = gaussian.kl(samples.proximal_mean, samples.proximal_std, mean[:num_samples], std[:num_samples])
        scalars["kl"] = kl.detach().mean()
    if cloning is not None:
        scalars["cloning_loss"] = cloning_loss(log_prob[num_samples:], cloning.proximal_log_prob, how.clip)
        loss = loss + how.weight * scalars["cloning_loss"]
    return loss, scalars


def clipped_surrogate(
    log_prob: Tensor, reference_log_prob: Tensor, advantage: Tensor, clip: float, dual_clip: float
) -> tuple[Tensor, Tensor]:
    """PPO's clipped surrogate (Schulman et al. 2017, eq. 7) with the dual clip of Ye et al. (2020, eq. 5).

    The dual clip bounds the objective of a negative advantage from below by ``dual_clip * advantage``, so a single
    action that became far more likely cannot dominate the batch.

    Args:
        log_prob: (B,) of the actions under the policy that learns.
        reference_log_prob: (B,) of the same under the policy around which ratios are clipped.
        advantage: (B,) normalised.
        clip: epsilon.
        dual_clip: greater than 1.

    Returns:
        The loss, a mean, and the share of ratios outside ``1 +- clip`` (no gradient).
    """
    ratio = gaussian.log_ratio(log_prob, reference_log_prob).exp()
    objective = torch.minimum(ratio * advantage, ratio.clamp(1.0 - clip, 1.0 + clip) * advantage)
    bounded = torch.where(advantage < 0.0, torch.maximum(objective, dual_clip * advantage), objective)
    clip_fraction = ((ratio.detach() - 1.0).abs() > clip).float().mean()
    return -bounded.mean(), clip_fraction


def importance_weight(proximal_log_prob: Tensor, behaviour_log_prob: Tensor) -> Tensor:
    """Importance weight (B,) of the behaviour policy's actions, at most ``MAX_IMPORTANCE_WEIGHT``."""
    return gaussian.log_ratio(proximal_log_prob, behaviour_log_prob).exp().clamp(max=MAX_IMPORTANCE_WEIGHT)


def cloning_loss(log_prob: Tensor, proximal_log_prob: Tensor, clip: float) -> Tensor:
    """Alice behavioural cloning (OpenAI 2021): the clipped surrogate with advantage 1, ``-mean(min(ratio, 1 + clip))``.

    An action that is already ``1 + clip`` times likelier than at the start of the update has no gradient.
    """
    return -gaussian.log_ratio(log_prob, proximal_log_prob).exp().clamp(max=1.0 + clip).mean()


def value_loss(value: Tensor, target: Tensor) -> Tensor:
    """Half the mean squared error."""
    return 0.5 * (value - target).square().mean()


def _adapted_learning_rate(player: Player, kl: float) -> float:
    """A lower learning rate after an update that moved too far, a higher one after one that hardly moved.

    One that was stopped early moved too far as well, whatever its KL: its step was so long that most of what was
    played was not learned from.
    """
    low, high = (player.config.learning_rate * bound for bound in LEARNING_RATE_BOUNDS)
    if kl > 2.0 * player.config.target_kl:
        return max(player.optimizer.learning_rate / LEARNING_RATE_STEP, low)
    if kl < 0.5 * player.config.target_kl:
        return min(player.optimizer.learning_rate * LEARNING_RATE_STEP, high)
    return player.optimizer.learning_rate


def _highest_learning_rate(player: Player, version: int) -> float:
    """The highest learning rate of an update: the upper bound, or less where the rate decays as 1 over their number.

    It is never below the lower bound, within which a resumed player has its rate.

    With steps like these the average of where gradient steps come by goes to one point (Robbins and Monro 1951, Polyak
    and Juditsky 1992); with steps of one length it wanders.
    """
    config, (low, high) = player.config, (player.config.learning_rate * bound for bound in LEARNING_RATE_BOUNDS)
    return max(low, high * min(1.0, (config.rate_decay_after_updates or math.inf) / (version + 1)))


def _join(turns: Sequence[Turns], name: str) -> Array:
    """A (T, N, ...) field of all turns, worlds that ``learn`` only."""
    joined: Array = np.concatenate([getattr(part, name)[:, part.learn] for part in turns], axis=1)
    return joined
