"""The central learner."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from service.actors.rollout import Rollout, Turns, turns_from_arrays, turns_to_arrays
from service.config import Config
from service.envs.observations import MIRROR_ACTION, MIRROR_BOB, MIRROR_BOB_VALUE
from service.learner import random_state
from service.learner.demonstrations import DemonstrationHistory
from service.learner.diagnostics import cloning_metrics, composition_metrics
from service.learner.errors import LearnerError
from service.learner.ledger import Ledger
from service.learner.player import Player
from service.learner.samples import Cloning, Samples, collect, mirrored
from service.learner.update import probes, update_player
from service.learner.weights import Weights
from service.policies import networks

Arrays = dict[str, NDArray[Any]]
Metrics = dict[str, float]

MAX_POLICY_LAG = 2
"""A rollout of a version further behind is not learned from."""


class Learner:
    """Turns rollouts into policy versions.

    Call order: ``ingest`` any number of rollouts, ``update`` once, hand out ``weights``, and again. After an update,
    ``state`` holds all that ``load_state`` needs to continue as if nothing had happened, bit for bit.
    """

    def __init__(self, config: Config) -> None:
        """Make both players from ``config.seed``; this is version 0.

        Raises:
            LearnerError: CUDA is asked for and not there.
        """
        self.config = config
        self.version = 0
        self._device = torch_device(config.learner.device)
        with torch.random.fork_rng(devices=[]):
            torch.default_generator.manual_seed(config.seed)
            alice = networks.make_alice(config.policy), networks.make_alice_value(config.policy)
            bob = networks.make_bob(config.policy), networks.make_bob_value(config.policy)
        self._alice = Player(*alice, config.learner.alice, self._device)
        self._bob = Player(*bob, config.learner.bob, self._device)
        self._bob_policy = bob[0]
        self._rng = np.random.Generator(np.random.PCG64(config.seed))
        self._history = DemonstrationHistory(config.learner.abc.num_iterations)
        self._ledger = Ledger()
        self._pending: dict[tuple[int, int, int], Rollout] = {}
        self._turns: list[Turns] = []  # Alice's, since her last update
        self._steady_bob = networks.export_parameters(bob[0])
        self._window: deque[list[Turns]] = deque(maxlen=config.learner.bob_window)  # Bob's, of the last iterations

    def ingest(self, rollout: Rollout) -> bool:
        """Take a rollout for the next update.

        Returns:
            False if it was counted before, or comes from a policy version more than two behind or one that this
            learner has not published (actors may be ahead of a learner that was resumed).
        """
        if rollout.id in self._ledger or rollout.id in self._pending:
            return False
        if not 0 <= self.version - rollout.policy_version <= MAX_POLICY_LAG:
            return False
        self._pending[rollout.id] = rollout
        return True

    def update(self) -> Metrics:
        """Learn from all rollouts taken since the last update, in the order of their ids; makes the next version.

        Returns:
            Metrics named ``learner/...``; one that could not be measured is left out.

        Raises:
            LearnerError: there are none.
        """
        if not self._pending:
            raise LearnerError("learner update with 0 rollouts: ingest at least one first")
        rollouts = [self._pending[key] for key in sorted(self._pending)]
        metrics = self._update_alice(rollouts)
        for name, value in self._update_bob(rollouts).items():
            metrics[name] = metrics.get(name, 0.0) + value  # only counts of failures are both players'
        for rollout in rollouts:
            self._ledger.add(rollout.id)
        self._pending.clear()
        self.version += 1
        self._average_bob()
        metrics["version"] = float(self.version)
        return {f"learner/{name}": value for name, value in metrics.items() if math.isfinite(value)}

    def weights(self) -> Weights:
        """Both policies of the current version, as copies."""
        alice, bob = (networks.export_parameters(player.policy) for player in (self._alice, self._bob))
        return Weights(self.version, alice, bob, {name: array.copy() for name, array in self._steady_bob.items()})

    def state(self) -> Arrays:
        """Everything a resumed run needs, as arrays by name; rollouts not yet learned from are not part of it."""
        parts = {"alice": self._alice.state(), "bob": self._bob.state(), "demonstrations": self._history.state()}
        parts |= {"steady_bob": {name: array.copy() for name, array in self._steady_bob.items()}}
        parts |= _named("turns", self._turns)
        for index, turns in enumerate(self._to_come_back()):
            parts |= _named(f"window/{index:04}", turns)
        nested = {f"{part}/{name}": array for part, arrays in parts.items() for name, array in arrays.items()}
        version = np.array(self.version, dtype=np.int64)
        return nested | {"version": version, "rng": random_state.dump(self._rng), "counted": self._ledger.state()}

    def load_state(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Continue exactly where ``state`` was taken, by a learner of the same configuration.

        Raises:
            LearnerError: an array is missing, left over or does not fit; the learner is as it was then.
        """
        state = dict(state)
        try:
            own = {name: state.pop(name) for name in ("version", "rng", "counted")}
            steady_bob = {name: np.array(state.pop(f"steady_bob/{name}")) for name in self._steady_bob}
            history = {name: state.pop(f"demonstrations/{name}") for name in ("observation", "action", "num_steps")}
        except KeyError as error:
            raise LearnerError(f"learner state: no array {error}; take an undamaged checkpoint") from None
        played = {name: state.pop(name) for name in list(state) if name.startswith(("turns/", "window/"))}
        self._load_players(state)
        self._steady_bob = steady_bob
        self._turns = _turns(_part(played, "turns"))
        window = _part(played, "window")
        self._window.clear()
        self._window.extend(_turns(_part(window, index)) for index in _indices(window))
        self.version = int(own["version"])
        self._rng = random_state.load(own["rng"])
        self._ledger.load_state(own["counted"])
        self._history.load_state(history)
        self._pending.clear()

    def _average_bob(self) -> None:
        """Move the average towards the new version; faster at first, when it is mostly the untrained Bob."""
        new, decay = networks.export_parameters(self._bob.policy), self.config.learner.bob_average_decay
        keep = min(decay, (1 + self.version) / (10 + self.version))
        old = self._steady_bob if keep > 0.0 else new
        self._steady_bob = {
            name: np.asarray(each + np.float32(keep) * (old[name] - each)) for name, each in new.items()
        }

    def _to_come_back(self) -> list[list[Turns]]:
        """What of Bob's window the next update will use again: all but what then falls out of it."""
        window = list(self._window)
        return window[1:] if len(window) == self.config.learner.bob_window else window

    def _load_players(self, state: Arrays) -> None:
        players = {"alice": self._alice, "bob": self._bob}
        for name in state:
            if name.partition("/")[0] not in players:
                raise LearnerError(f"learner state {name!r}: no such part; take a checkpoint of this format version")
        states = {key: _part(state, key) for key in players}
        for key, player in players.items():
            player.check_state(states[key], where=key)
        for key, player in players.items():
            player.load_state(states[key])

    def _update_alice(self, rollouts: Sequence[Rollout]) -> Metrics:
        alice = self._alice
        self._turns += [rollout.alice for rollout in rollouts]
        if (self.version + 1) % self.config.learner.alice_interval:
            return {"non_finite_steps": 0.0, "rollbacks": 0.0}
        turns, self._turns = self._turns, []
        samples = collect(turns, alice.value, alice.policy, self.config.learner.alice, self._device)
        metrics = update_player(self._alice, samples, None, self.config.learner.abc, self._rng)
        return _prefixed("alice", metrics) | {"num_alice_samples": float(_length(samples))}

    def _update_bob(self, rollouts: Sequence[Rollout]) -> Metrics:
        config, bob = self.config.learner, self._bob
        self._window.append([rollout.bob for rollout in rollouts])
        turns = [each for iteration in self._window for each in iteration]
        samples = collect(turns, bob.value, bob.policy, config.bob, self._device)
        metrics = {"num_bob_samples": float(_length(samples))}
        if samples is not None and config.mirror:
            samples = mirrored(samples, bob.policy, MIRROR_BOB, MIRROR_BOB_VALUE, MIRROR_ACTION)
        cloning = self._cloning(rollouts)
        metrics["num_demonstrations"] = float(_length(cloning) // (2 if config.mirror else 1))
        metrics |= _prefixed("bob", update_player(bob, samples, cloning, config.abc, self._rng))
        rows = samples if samples is not None else cloning
        if rows is not None and isinstance(self._bob_policy, networks.MCPPolicy):
            metrics |= composition_metrics(self._bob_policy, probes(rows.observation))
        if cloning is not None:
            metrics |= cloning_metrics(bob, Cloning(*(probes(column) for column in cloning.tensors())))
        return metrics

    def _cloning(self, rollouts: Sequence[Rollout]) -> Cloning | None:
        """The demonstrations to clone, this update's among them; None if there are none or they have no weight."""
        self._history.append([rollout.demonstrations for rollout in rollouts])
        kept = self._history.joined()
        observation, action = kept.observation, kept.action
        if len(action) == 0 or self.config.learner.abc.weight == 0.0:
            return None
        if self.config.learner.mirror:
            observation = np.concatenate((observation, MIRROR_BOB(observation)))
            action = np.concatenate((action, MIRROR_ACTION(action)))
        rows, actions = (torch.from_numpy(array).to(self._device) for array in (observation, action))
        with torch.no_grad():
            return Cloning(rows, actions, self._bob.log_prob(rows, actions))


def _prefixed(player: str, metrics: Metrics) -> Metrics:
    """Put the player's name before those that both have."""
    shared = ("cloning_loss", "non_finite_steps", "rollbacks")
    return {name if name in shared else f"{player}_{name}": value for name, value in metrics.items()}


def _part(state: Arrays, key: str) -> Arrays:
    return {name.removeprefix(f"{key}/"): array for name, array in state.items() if name.startswith(f"{key}/")}


def _named(prefix: str, turns: Sequence[Turns]) -> dict[str, Arrays]:
    return {f"{prefix}/{index:04}": turns_to_arrays(each) for index, each in enumerate(turns)}


def _indices(state: Arrays) -> list[str]:
    return sorted({name.partition("/")[0] for name in state})


def _turns(state: Arrays) -> list[Turns]:
    return [turns_from_arrays(_part(state, index)) for index in _indices(state)]


def _length(rows: Samples | Cloning | None) -> int:
    return 0 if rows is None else len(rows)


def torch_device(name: str) -> torch.device:
    """The device that ``learner.device`` names.

    Raises:
        LearnerError: it is not there.
    """
    if name == "cuda" and not torch.cuda.is_available():
        raise LearnerError("learner.device = 'cuda': torch finds no CUDA device here; set learner.device=cpu")
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    return torch.device(name)
