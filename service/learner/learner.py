"""The central learner."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from service.actors.rollout import MAX_POLICY_LAG, Demonstrations, Rollout, Turns, Weights
from service.base.errors import ConfigError
from service.base.tensors import join_parts, split_parts
from service.base.types import Array, Arrays, Metrics
from service.config.self_play import SelfPlayConfig
from service.envs.observations import Layouts, layouts
from service.learner import ppo, transfer
from service.learner.diagnostics import composition_metrics, probes
from service.learner.player import Player
from service.learner.samples import (
    DemonstrationHistory,
    DemonstrationRows,
    Samples,
    reflect_at_random,
)
from service.policies import networks

DEMONSTRATIONS, IMITATED = "demonstrations", "imitated"
"""Names of what is cloned in a learner's state, each a ``DemonstrationHistory``."""
_LOW_WORD = (1 << 64) - 1
_BOB_EMA = "bob_ema"
"""Bob's moving average in a checkpoint."""


class Learner:
    """The learner of both players: rollouts in, policy versions out.

    Call order: ``ingest`` any number of rollouts, ``update`` once, hand out ``weights``, and again. After an update,
    ``state`` holds all that ``load_state`` needs to continue as if nothing had happened, bit for bit.
    """

    def __init__(self, config: SelfPlayConfig) -> None:
        """Make both players from ``config.seed``; this is version 0.

        Raises:
            ConfigError: CUDA is asked for and not there.
        """
        torch.set_num_threads(config.learner.num_threads)
        self.config = config
        self.version = 0
        self.update_s = 0.0
        """Duration of the last update, seconds."""
        self._layouts = seen = layouts(config.world)
        self._device = torch_device(config.learner.device)
        with torch.random.fork_rng(devices=[]):
            torch.default_generator.manual_seed(config.seed)
            value = config.policy.value
            alice = networks.make_alice(config.policy, seen), networks.ValueNetwork(seen.full.normalisation, value)
            bob = networks.make_bob(config.policy, seen), networks.ValueNetwork(seen.bob_value.normalisation, value)
        self._alice = Player(*alice, config.learner.alice, self._device)
        self._bob = Player(*bob, config.learner.bob, self._device)
        self._mirrored = config.learner.bob.mirror == "random" and config.world.is_symmetric
        self._rng = np.random.Generator(np.random.PCG64(config.seed))
        self._histories = {DEMONSTRATIONS: DemonstrationHistory(config.learner.abc.num_iterations, seen.bob.size)}
        if config.learner.self_imitation.weight:
            self._histories[IMITATED] = DemonstrationHistory(
                config.learner.self_imitation.num_iterations, seen.full.size
            )
        self._counted: dict[tuple[int, int], int] = {}  # (actor, incarnation) to the last sequence learned from
        self._pending: dict[tuple[int, int, int], Rollout] = {}
        self._bob_ema = networks.export_parameters(bob[0])

    def ingest(self, rollout: Rollout) -> bool:
        """Take a rollout for the next update.

        Returns:
            False if it was counted before, or comes from a policy version more than two behind or one that this
            learner has not published (actors may be ahead of a learner that was resumed).
        """
        actor, incarnation, sequence = rollout.id  # an actor's rollouts come in order
        if sequence <= self._counted.get((actor, incarnation), -1) or rollout.id in self._pending:
            return False
        if not 0 <= self.version - rollout.policy_version <= MAX_POLICY_LAG:
            return False
        self._pending[rollout.id] = rollout
        return True

    def update(self) -> Metrics:
        """Learn from all rollouts taken since the last update, in the order of their ids; makes the next version.

        Returns:
            Metrics named ``learner/...``; one that could not be measured is left out.
        """
        start = time.perf_counter()
        rollouts = [self._pending[key] for key in sorted(self._pending)]
        assert rollouts, "ingest at least one first"
        metrics = self._update_alice(rollouts)
        for name, value in self._update_bob(rollouts).items():
            metrics[name] = metrics.get(name, 0.0) + value  # only counts of failures are both players'
        self._counted |= {(actor, incarnation): sequence for actor, incarnation, sequence in sorted(self._pending)}
        self._pending.clear()
        lags = [self.version - rollout.policy_version for rollout in rollouts]
        metrics |= {"policy_lag": float(np.mean(lags)), "max_policy_lag": float(max(lags))}
        self.version += 1
        self._average_bob()
        metrics["version"] = float(self.version)
        self.update_s = time.perf_counter() - start
        return {f"learner/{name}": value for name, value in metrics.items() if math.isfinite(value)}

    def take_over(self, networks_by_name: Mapping[str, Mapping[str, Array]], seen: Layouts) -> list[str]:
        """Take what fits of trained networks, before anything is learned; see ``transfer.take_over``.

        Args:
            networks_by_name: parameters of ``alice/policy``, ``alice/value``, ``bob/policy`` and ``bob/value``, those
                that there are.
            seen: layouts of the world that they were trained in.

        Returns:
            A line for each of the four, which says what was taken.
        """
        assert self.version == 0
        lines = []
        for name, part, inputs in (
            ("bob/policy", self._bob.policy, transfer.BOB_INPUTS),
            ("bob/value", self._bob.value, ("bob_value",)),
            ("alice/policy", self._alice.policy, ("full",)),
            ("alice/value", self._alice.value, ("full",)),
        ):
            given, what = networks_by_name.get(name), "nothing there, begins anew"
            if given is not None:
                what = transfer.take_over(part, given, seen, self._layouts, inputs)
            lines.append(f"{name}: {what}")
        self._bob_ema = networks.export_parameters(self._bob.policy)
        return lines

    def weights(self) -> Weights:
        """Both policies of the current version, as copies."""
        alice, bob = (networks.export_parameters(player.policy) for player in (self._alice, self._bob))
        return Weights(self.version, alice, bob, {name: array.copy() for name, array in self._bob_ema.items()})

    def state(self) -> Arrays:
        """Everything a resumed run needs, as arrays by name; rollouts not yet learned from are not part of it."""
        parts = {name: history.state() for name, history in self._histories.items()}
        parts |= {"alice": self._alice.state(), "bob": self._bob.state()}
        parts |= {_BOB_EMA: {name: array.copy() for name, array in self._bob_ema.items()}}
        counted = [(*source, sequence) for source, sequence in sorted(self._counted.items())]
        return join_parts(parts) | {
            "version": np.array(self.version, dtype=np.int64),
            "rng": _rng_to_array(self._rng),
            "counted": np.array(counted, dtype=np.int64).reshape(-1, 3),
        }

    def load_state(self, state: Mapping[str, Array]) -> None:
        """Continue exactly where ``state`` was taken, by a learner of the same configuration."""
        parts = split_parts(state)
        self._alice.load_state(parts["alice"])
        self._bob.load_state(parts["bob"])
        self._bob_ema = {name: np.array(parts[_BOB_EMA][name]) for name in self._bob_ema}
        self.version = int(state["version"])
        self._rng = _rng_from_array(state["rng"])
        self._counted = {(int(actor), int(incarnation)): int(last) for actor, incarnation, last in state["counted"]}
        for name, history in self._histories.items():
            history.load_state(parts[name])
        self._pending.clear()

    def _average_bob(self) -> None:
        """Move the average towards the new version.

        It spans about an eighth of all versions until that reaches the decay's own span (polynomial-decay averaging,
        Shamir and Zhang 2013): while Bob still learns fast, a long average lags behind him.
        """
        new, decay = networks.export_parameters(self._bob.policy), self.config.learner.bob_ema_decay
        keep = min(decay, (1 + self.version) / (8 + self.version))
        old = self._bob_ema if keep > 0.0 else new
        self._bob_ema = {name: np.asarray(each + np.float32(keep) * (old[name] - each)) for name, each in new.items()}

    def _update_alice(self, rollouts: Sequence[Rollout]) -> Metrics:
        samples = ppo.collect([rollout.alice for rollout in rollouts], self._alice)
        counted = {"num_alice_samples": float(_num(samples))}
        how, imitated = self.config.learner.self_imitation, None
        if IMITATED in self._histories:
            imitated = self._to_clone(IMITATED, [paid_well(each.alice, how.min_reward) for each in rollouts])
            counted["num_imitated"] = float(_num(imitated))
            # A few turns that are cycled through many times would count for more than all others together.
            share = _num(imitated) / max(how.rows_per_sample * counted["num_alice_samples"], 1.0)
            how = how.model_copy(update={"weight": how.weight * min(1.0, share)})
        metrics = ppo.update(self._alice, samples, imitated, how, self._rng, version=self.version)
        return _prefixed("alice", metrics) | counted

    def _update_bob(self, rollouts: Sequence[Rollout]) -> Metrics:
        config, bob = self.config.learner, self._bob
        samples = ppo.collect([rollout.bob for rollout in rollouts], bob)
        metrics = {"num_bob_samples": float(_num(samples))}
        mirrored, helped = self._mirrored, solved_share(rollouts) <= config.bob_help_max_success
        if samples is not None and mirrored and helped:
            samples = reflect_at_random(samples, self._layouts, bob, self._rng)
        demonstrations = self._to_clone(DEMONSTRATIONS, [each.demonstrations for each in rollouts])
        metrics["num_demonstrations"] = float(_num(demonstrations) // (1 + mirrored))
        updated = ppo.update(
            bob, samples, demonstrations if helped else None, config.abc, self._rng, version=self.version
        )
        metrics |= _prefixed("bob", updated)
        rows = samples if samples is not None else demonstrations
        if rows is not None and isinstance(bob.policy, networks.MCPPolicy):
            probed = rows.take(probes(len(rows)))
            metrics |= composition_metrics(bob.policy, probed.observation)
        return metrics

    def _to_clone(self, name: str, new: Sequence[Demonstrations]) -> DemonstrationRows | None:
        """What a history keeps, this update's among it; None if there are none or they have no weight."""
        history, config = self._histories[name], self.config.learner
        how = config.abc if name == DEMONSTRATIONS else config.self_imitation
        reflection = self._layouts.bob.mirror if name == DEMONSTRATIONS and self._mirrored else None
        history.append(new)
        kept = history.joined()
        observation, action = (torch.from_numpy(each).to(self._device) for each in (kept.observation, kept.action))
        return DemonstrationRows(observation, action, reflection) if len(action) and how.weight else None


def paid_well(turns: Turns, min_reward: float) -> Demonstrations:
    """The steps of the turns that ``learn`` and were paid at least ``min_reward``."""
    chosen = turns.active & (turns.learn & (turns.reward.sum(axis=0) >= min_reward))
    return Demonstrations(turns.observation[chosen], turns.action[chosen])


def solved_share(rollouts: Sequence[Rollout]) -> float:
    """Share of the current Bob's turns that he solved, whatever their goals; 0 where there were none."""
    tried = [each.records.played & ~each.records.bob_past for each in rollouts]
    solved = np.concatenate([each.records.solved[these] for each, these in zip(rollouts, tried, strict=True)])
    return float(solved.mean()) if len(solved) else 0.0


def _num(rows: Samples | DemonstrationRows | None) -> int:
    return 0 if rows is None else len(rows)


def _prefixed(player: str, metrics: Metrics) -> Metrics:
    """Put the player's name before those that both have."""
    shared = ["non_finite_steps", "rollbacks"]
    if player == "bob":  # recorded runs have these of his without a prefix
        shared += ["cloning_loss", "demonstration_log_prob", "demonstration_log_ratio"]
    return {name if name in shared else f"{player}_{name}": value for name, value in metrics.items()}


def _rng_to_array(rng: np.random.Generator) -> NDArray[np.uint64]:
    """A PCG64 generator as six words (6,): its 128-bit state and increment in halves, then its buffered half-draw."""
    state = rng.bit_generator.state
    wide = (word for value in state["state"].values() for word in (value >> 64, value & _LOW_WORD))
    return np.array([*wide, state["has_uint32"], state["uinteger"]], dtype=np.uint64)


def _rng_from_array(words: NDArray[np.uint64]) -> np.random.Generator:
    """The generator that ``_rng_to_array`` made these (6,) words of."""
    high, low, inc_high, inc_low, has_half, half = words.tolist()
    rng = np.random.Generator(np.random.PCG64())
    rng.bit_generator.state = {
        "bit_generator": "PCG64",
        "state": {"state": high << 64 | low, "inc": inc_high << 64 | inc_low},
        "has_uint32": has_half,
        "uinteger": half,
    }
    return rng


def torch_device(name: str) -> torch.device:
    """The device that ``learner.device`` names.

    Raises:
        ConfigError: it is not there.
    """
    if name == "cuda" and not torch.cuda.is_available():
        raise ConfigError("learner.device = 'cuda': torch finds no CUDA device here; set learner.device=cpu")
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    return torch.device(name)
