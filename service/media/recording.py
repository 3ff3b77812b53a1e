"""Rounds and episodes played for the camera: the states a video is drawn from. Nothing is drawn or learned here."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from service.actors.evaluation import Deterministic
from service.actors.self_play import Acting
from service.config import Config, WorldConfig
from service.envs.batch import WorldBatch
from service.envs.goals import GoalKind, draw_goals
from service.generator.difficulty import in_air
from service.generator.validity import Verdict, classify_goal

StateArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

_NUM_WORLDS = 64
_MAX_BATCHES = 3


@dataclass(frozen=True, slots=True)
class Take:
    """One round: Alice's turn, and Bob's from the same start. Without a valid goal he has no turn."""

    alice_states: StateArray
    """(T1 + 1, S) from the start to where she left the object; rows of ``WorldBatch.states``."""
    bob_states: StateArray
    """(T2 + 1, S) from the start until he solved it or ran out of time; the start alone when he had no turn."""
    goal: StateArray
    """(3,) metres."""
    solved: bool
    verdict: Verdict = Verdict.VALID


@dataclass(frozen=True, slots=True)
class Episodes:
    """Bob on N random goals, each for T steps from a fresh reset."""

    states: StateArray
    """(T + 1, N, S)."""
    goal: StateArray
    """(N, 3) metres."""
    reached: BoolArray
    """(T + 1, N) the object is within the success distance."""


@dataclass(frozen=True, slots=True)
class _Proposals:
    """What P of Alice's turns came to."""

    states: StateArray
    """(P, T + 1, S)."""
    start: StateArray
    """(P, 3) object position, metres."""
    end: StateArray
    """(P, 3) object position, metres: the goal where valid."""
    verdict: NDArray[np.int8]
    """(P,)."""


def film_rounds(config: Config, alice: Acting, bob: Deterministic, *, num_rounds: int, seed: int) -> list[Take]:
    """Play rounds from fresh resets and keep the most interesting ones: valid goals, lifted ones first, far ones first.

    Alice samples her actions as in training; Bob acts without noise. An Alice who makes too few valid goals in a few
    hundred turns is shown with those that are not.

    Returns:
        ``num_rounds`` takes, the most interesting first.
    """
    rng = np.random.default_rng(seed)
    proposals = _propose(config, alice, num_rounds, rng)
    order = _by_interest(proposals, config.world.object_size_m / 2)[:num_rounds]
    chosen = _Proposals(proposals.states[order], proposals.start[order], proposals.end[order], proposals.verdict[order])
    return _answer(config, bob, chosen)


def film_episodes(
    bob: Deterministic,
    config: WorldConfig,
    kind: GoalKind,
    *,
    num_episodes: int,
    num_steps: int,
    success_distance_m: float,
    seed: int,
) -> Episodes:
    """Play random goals as ``actors.evaluation`` does, and keep every state."""
    rng = np.random.default_rng(seed)
    with WorldBatch(config, num_episodes) as worlds:
        worlds.reset(rng)
        start, box = worlds.object_position, worlds.box_place
        goal = draw_goals(kind, rng, config, success_distance_m, start=start, box=box)
        states, reached = [], []
        for step in range(num_steps + 1):
            if step:
                worlds.step(bob.act_deterministic(_bob_input(worlds, goal)))
            states.append(worlds.states.copy())
            reached.append(np.linalg.norm(worlds.object_position - goal, axis=1) <= success_distance_m)
    return Episodes(np.stack(states), goal, np.stack(reached))


def _propose(config: Config, alice: Acting, num_rounds: int, rng: np.random.Generator) -> _Proposals:
    """Let Alice play batches of turns until enough are valid, or a few batches are over."""
    turns: list[_Proposals] = []
    with WorldBatch(config.world, max(_NUM_WORLDS, num_rounds), num_threads=config.run.num_threads) as worlds:
        for _ in range(_MAX_BATCHES):
            turns.append(_play_alice(config, alice, worlds, rng))
            if sum(int((turn.verdict == Verdict.VALID).sum()) for turn in turns) >= num_rounds:
                break
    return _Proposals(
        states=np.concatenate([turn.states for turn in turns]),
        start=np.concatenate([turn.start for turn in turns]),
        end=np.concatenate([turn.end for turn in turns]),
        verdict=np.concatenate([turn.verdict for turn in turns]),
    )


def _play_alice(config: Config, alice: Acting, worlds: WorldBatch, rng: np.random.Generator) -> _Proposals:
    game = config.game
    worlds.reset(rng)
    start, states = worlds.object_position.copy(), [worlds.states.copy()]
    broken = np.zeros(worlds.num_worlds, dtype=bool)
    for step in range(game.alice_steps):
        action, _ = alice.act(worlds.full(step / game.alice_steps), rng)
        broken |= worlds.step(action)
        states.append(worlds.states.copy())
    end = worlds.object_position.copy()
    verdict = classify_goal(start, end, config.world.workspace, game.success_distance_m)
    verdict[broken] = Verdict.FALLEN
    return _Proposals(np.stack(states, axis=1), start, end, verdict)


def _by_interest(proposals: _Proposals, rest_height_m: float) -> NDArray[np.int64]:
    distance = np.linalg.norm(proposals.end - proposals.start, axis=1)
    lifted = in_air(proposals.end, rest_height_m)
    return np.lexsort((distance, lifted, proposals.verdict == Verdict.VALID))[::-1]


def _answer(config: Config, bob: Deterministic, proposals: _Proposals) -> list[Take]:
    """Let Bob try the valid ones, all at once."""
    game, num = config.game, len(proposals.verdict)
    num_steps, solved = np.zeros(num, dtype=np.int64), np.zeros(num, dtype=bool)
    with WorldBatch(config.world, num, num_threads=config.run.num_threads) as worlds:
        worlds.restore(proposals.states[:, 0])
        states = [worlds.states.copy()]
        playing = proposals.verdict == Verdict.VALID
        for _ in range(game.bob_steps):
            index = np.flatnonzero(playing)
            if not index.size:
                break
            broken = worlds.step(bob.act_deterministic(_bob_input(worlds, proposals.end)[index]), index)
            states.append(worlds.states.copy())
            num_steps[index] += 1
            solved |= playing & (
                np.linalg.norm(worlds.object_position - proposals.end, axis=1) <= game.success_distance_m
            )
            playing &= ~(solved | broken)
    bob_states = np.stack(states, axis=1)
    return [
        Take(
            alice_states=proposals.states[row],
            bob_states=bob_states[row, : num_steps[row] + 1],
            goal=proposals.end[row],
            solved=bool(solved[row]),
            verdict=Verdict(proposals.verdict[row]),
        )
        for row in range(num)
    ]


def _bob_input(worlds: WorldBatch, goal: StateArray) -> NDArray[np.float32]:
    return np.concatenate([worlds.positions(), goal.astype(np.float32)], axis=1)
