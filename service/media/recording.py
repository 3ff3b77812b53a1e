"""Recorded rounds and episodes: the states from which a video is drawn.

Rounds are played by ``SelfPlay`` and episodes by ``evaluate``, so a video obeys the rules of training and evaluation.
Nothing is drawn or learned here.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice

import numpy as np

from service.actors.coverage import skill_paths
from service.actors.evaluation import DeterministicPolicy, evaluate
from service.actors.self_play import Players, SelfPlay, StochasticPolicy
from service.base.progress import track
from service.base.types import BoolArray, FloatArray, StateArray
from service.config import WorldConfig
from service.config.self_play import SelfPlayConfig
from service.envs.batch import WorldBatch
from service.envs.observations import distances
from service.envs.sampling import GoalKind
from service.envs.task import Task
from service.generator.bins import highest, in_air
from service.generator.generator import TaskGenerator
from service.generator.opponents import Opponents
from service.generator.records import GoalRecords
from service.generator.snapshot import GeneratorSnapshot
from service.generator.validity import Verdict
from service.policies.frozen_skills import FrozenSkills
from service.registry.loading import Trained

_NUM_WORLDS = 64
_MAX_ROLLOUTS = 3
_Interest = tuple[bool, bool, float]


@dataclass(frozen=True, slots=True)
class RecordedRound:
    """One round in one world: Alice's turn, and Bob's from the same start. Without a valid goal he has no turn.

    Where Alice does not play, her turn has no step.
    """

    alice_states: StateArray
    """(T1 + 1, S) from the start to where she left the object; rows of ``WorldBatch.states``."""
    alice_actions: FloatArray
    """(T1, 4)."""
    bob_states: StateArray
    """(T2 + 1, S) from the start to the end of his turn; the start alone when he had no turn."""
    bob_actions: FloatArray
    """(T2, 4)."""
    goal: StateArray
    """(3 K,) metres."""
    solved: bool
    verdict: Verdict = Verdict.VALID


@dataclass(frozen=True, slots=True)
class RecordedEpisodes:
    """Bob on N random goals, or N random skills, each for T steps from a fresh reset."""

    states: StateArray
    """(T + 1, N, S)."""
    goal: StateArray | None
    """(N, 3 K) metres; None for skills, which have no goal."""
    reached: BoolArray
    """(T + 1, N) each object is within the success distance, or a task's success."""
    actions: FloatArray | None = None
    """(T, N, 4); None where they were not kept."""

    def first(self, num: int) -> RecordedEpisodes:
        """The first ones."""
        goal = None if self.goal is None else self.goal[:num]
        actions = None if self.actions is None else self.actions[:, :num]
        return RecordedEpisodes(self.states[:, :num], goal, self.reached[:, :num], actions)


def play_rounds(
    config: SelfPlayConfig, alice: StochasticPolicy, bob: DeterministicPolicy, *, num_rounds: int, seed: int
) -> list[RecordedRound]:
    """Play rounds from fresh resets and keep them as they come, whatever became of their goals.

    Alice samples her actions as in training; Bob acts without noise.
    """
    num_worlds = min(_NUM_WORLDS, num_rounds)
    num_batches = math.ceil(num_rounds / num_worlds)
    batches = islice(_play(config, alice, bob, num_worlds=num_worlds, seed=seed), num_batches)
    played = track(batches, "playing rounds", num_batches, "batches")
    return [each for _, recorded in played for each in recorded][:num_rounds]


def record_rounds(
    config: SelfPlayConfig, alice: StochasticPolicy, bob: DeterministicPolicy, *, num_rounds: int, seed: int
) -> list[RecordedRound]:
    """Play rounds from fresh resets and keep the most interesting: valid goals, lifted ones first, far ones first.

    Alice samples her actions as in training; Bob acts without noise. If Alice makes too few valid goals in about two
    hundred turns, some of the others are kept.

    Returns:
        ``num_rounds`` rounds, the most interesting first.
    """
    rounds: list[tuple[_Interest, RecordedRound]] = []
    played = _play(config, alice, bob, num_worlds=max(_NUM_WORLDS, num_rounds), seed=seed)
    batches = islice(played, _MAX_ROLLOUTS)
    for records, recorded in track(batches, "playing rounds", _MAX_ROLLOUTS, "batches at most"):
        rounds += zip(_interest(records, config.world), recorded, strict=True)
        if sum(played for (played, *_), _ in rounds) >= num_rounds:
            break
    rounds.sort(key=lambda pair: pair[0], reverse=True)
    return [each for _, each in rounds[:num_rounds]]


def record_episodes(
    bob: DeterministicPolicy,
    config: WorldConfig,
    task: Task | GoalKind,
    *,
    num_episodes: int,
    num_steps: int,
    success_distance_m: float,
    seed: int,
    goal: StateArray | None = None,
) -> RecordedEpisodes:
    """Play the episodes that ``evaluate`` plays with these arguments, and keep every state."""
    kept: list[tuple[StateArray, StateArray, BoolArray]] = []
    acting = _Keeping(bob)

    def keep(worlds: WorldBatch, goal: StateArray, reached: BoolArray) -> None:
        kept.append((worlds.states.copy(), goal, reached))

    evaluate(
        acting,
        config,
        task,
        num_episodes=num_episodes,
        num_steps=num_steps,
        success_distance_m=success_distance_m,
        seed=seed,
        observe=keep,
        goal=goal,
    )
    states, goals, reached = map(np.stack, zip(*kept, strict=True))
    return RecordedEpisodes(states, goals[0], reached, np.stack(acting.actions))


def record_on_goals(
    trained: Trained, num_episodes: int, seed: int, goals: GoalKind | StateArray | None = None
) -> RecordedEpisodes:
    """Play episodes in which what was trained is tried, and keep every state.

    Args:
        trained: who acts.
        num_episodes: of random goals.
        seed: of starts and random goals.
        goals: a kind of random goals, or (N, 3 K) metres, one for each of N episodes; None: of its usual kind.
    """
    points = goals if isinstance(goals, np.ndarray) else None
    return record_episodes(
        trained.player(),
        trained.world,
        trained.on_goals(goals if isinstance(goals, str) else None),
        num_episodes=num_episodes if points is None else len(points),
        num_steps=trained.num_steps,
        success_distance_m=trained.success_distance_m,
        seed=seed,
        goal=points,
    )


def record_skills(
    skills: FrozenSkills, config: WorldConfig, *, num_skills: int, num_steps: int, seed: int
) -> RecordedEpisodes:
    """Play the random skills that ``skill_paths`` plays with these arguments, and keep every state."""
    kept: list[StateArray] = []
    skill_paths(
        skills,
        config,
        num_skills=num_skills,
        num_steps=num_steps,
        seed=seed,
        observe=lambda worlds: kept.append(worlds.states.copy()),
    )
    return RecordedEpisodes(np.stack(kept), None, np.zeros((num_steps + 1, num_skills), dtype=bool))


def _play(
    config: SelfPlayConfig, alice: StochasticPolicy, bob: DeterministicPolicy, *, num_worlds: int, seed: int
) -> Iterator[tuple[GoalRecords, list[RecordedRound]]]:
    """Rounds of that many worlds at once, each from a fresh reset, without end."""
    rng, game, generator = np.random.default_rng(seed), {"num_worlds": num_worlds}, dict[str, object]()
    if config.game.alice_plays:  # or else there are no goals but those of another source
        generator = {"goal_source": "alice", "replay_fraction": 0.0, "replay_invalid": False}
    config = config.model_copy(
        update={
            "game": config.game.model_copy(update=game),
            "generator": config.generator.model_copy(update=generator),
        }
    )
    players = Players(version=0, alice=alice, bob=_WithoutNoise(bob))
    with contextlib.closing(SelfPlay(config, rng, num_threads=config.run.num_threads)) as self_play:
        if config.game.blocked_gripper_min_success > 0.0:  # by now he has come to it
            self_play.block_grippers(1.0)
            self_play.start_over()
        snapshot = TaskGenerator(config, self_play.worlds.layout).snapshot()
        while True:
            yield _record(self_play, players, snapshot, rng)
            self_play.start_over()


class _Keeping:
    """A policy whose actions are kept."""

    def __init__(self, policy: DeterministicPolicy) -> None:
        self._policy = policy
        self.actions: list[FloatArray] = []

    def act_deterministic(self, observation: FloatArray) -> FloatArray:
        self.actions.append(self._policy.act_deterministic(observation))
        return self.actions[-1]


class _WithoutNoise:
    """A deterministic policy where one that samples is expected."""

    def __init__(self, policy: DeterministicPolicy) -> None:
        self._policy = policy

    def act(self, observation: FloatArray, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
        return self._policy.act_deterministic(observation), np.zeros(len(observation), dtype=np.float32)


def _record(
    self_play: SelfPlay, players: Players, snapshot: GeneratorSnapshot, rng: np.random.Generator
) -> tuple[GoalRecords, list[RecordedRound]]:
    """Play a round in every world and take each world's states and actions out of it."""
    plan = Opponents(0).plan(self_play.worlds.num_worlds, 0.0, rng)  # there are none
    states: list[StateArray] = []
    rollout = self_play.play_round(players, plan, snapshot, observe=lambda now: states.append(now.copy()))
    records, alice_steps = rollout.records, int(rollout.alice.active.any(axis=1).sum())
    num_hers = alice_steps + 1 if alice_steps else 0  # a turn that is left out has no start of its own
    bob_states = np.stack(states[num_hers:])
    alice_states = np.stack(states[:num_hers] or states[:1])
    return records, [
        RecordedRound(
            alice_states=alice_states[:, world],
            alice_actions=rollout.alice.action[:alice_steps, world],
            bob_states=bob_states[: bob_steps + 1, world],
            bob_actions=rollout.bob.action[:bob_steps, world],
            goal=records.goal[world],
            solved=bool(records.solved[world]),
            verdict=Verdict(records.verdict[world]),
        )
        for world, bob_steps in enumerate(records.num_bob_steps)
    ]


def _interest(records: GoalRecords, world: WorldConfig) -> Iterator[_Interest]:
    """Sort keys of each world's round: Bob played it, its goal is in the air, its distance in metres."""
    distance_m = distances(records.goal, records.start_position).max(axis=1)
    lifted = in_air(highest(records.goal, world), world.rest_height_m)
    return zip(records.played, lifted, distance_m, strict=True)
