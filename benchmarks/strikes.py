"""Who is killed when in a chaos run, and how soon the run is whole again, from what it told meanwhile.

All times are seconds since 1970: statuses carry the moments at which the driver heard of its workers.
"""

from __future__ import annotations

import random
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

from service.store.models import ActorStatus, RunStatus

Target = Literal["actor", "learner", "generator", "status", "redis"]
ACTOR_EVERY_S = 30.0
REDIS_AWAY_S = 30.0
_OTHERS: tuple[tuple[Target, float], ...] = (
    ("learner", 0.25),
    ("generator", 0.4),
    ("status", 0.5),
    ("learner", 0.6),
    ("redis", 0.75),
)
"""Whom else, and at what share of the run."""


@dataclass(frozen=True, slots=True)
class Planned:
    """Somebody to kill."""

    at_s: float
    """Since the beginning."""
    target: Target


@dataclass(frozen=True, slots=True)
class Strike:
    """Somebody who was killed."""

    at: float
    target: Target
    name: str
    """In the run's status."""
    incarnation: int = 0
    pid: int = 0
    num_env_steps: int = 0
    """Of the run so far."""


@dataclass(frozen=True, slots=True)
class Seen:
    """What a run told at some moment."""

    at: float
    status: RunStatus

    def actor(self, name: str) -> ActorStatus | None:
        """One of its parts."""
        return next((actor for actor in self.status.actors if actor.name == name), None)


@dataclass(frozen=True, slots=True)
class Recovery:
    """Seconds from a kill; None: not before the run ended, or nothing was seen of it."""

    up_s: float | None
    """Until another process has its place and answers."""
    working_s: float | None
    """Until its first rollout was handed over, or the first update it had a part in was out."""


def plan(duration_s: float, actor_every_s: float = ACTOR_EVERY_S) -> list[Planned]:
    """An actor every so often; learner twice, generator, status actor and Redis once, half-way between two actors.

    Nobody is struck in the last half interval, so that the last one's recovery can be seen.
    """
    end = duration_s - actor_every_s / 2
    actors = [Planned(at, "actor") for at in _multiples(actor_every_s, end)]
    others = [
        Planned(min(_nearest_gap(share * duration_s, actor_every_s), end - actor_every_s / 2), target)
        for target, share in _OTHERS
    ]
    return sorted(actors + others, key=lambda each: each.at_s)


def _multiples(step: float, end: float) -> list[float]:
    return [step * count for count in range(1, int(end // step) + 1)]


def _nearest_gap(at: float, every: float) -> float:
    """The middle between two strikes at actors that is nearest to ``at``."""
    return max(0.0, round(at / every - 0.5) + 0.5) * every


def choose_actor(status: RunStatus, rng: random.Random) -> ActorStatus | None:
    """A random rollout actor that is up; None while there is none."""
    up = [each for each in status.actors if each.name.startswith("rollout-") and each.state == "alive" and each.pid]
    return rng.choice(up) if up else None


def recovery(strike: Strike, seen: Sequence[Seen]) -> Recovery:
    """How soon the killed worker's place was taken, and how soon the next one's work was done.

    Args:
        strike: at a rollout actor, the learner or the generator.
        seen: in order, more often than a worker takes to come up.
    """
    later = [(each, actor) for each in seen if each.at >= strike.at and (actor := each.actor(strike.name)) is not None]
    new = [(each, actor) for each, actor in later if actor.incarnation > strike.incarnation]
    if not new:
        return Recovery(None, None)
    before, base = new[0]
    up = next((actor for _, actor in new if actor.state == "alive" and actor.pid), None)
    if strike.target == "actor":
        done = next((actor for _, actor in new if actor.num_rollouts > base.num_rollouts), None)
    else:
        done = next((actor for each, actor in new if each.status.iteration > before.status.iteration), None)
    return Recovery(_since(strike, up), _since(strike, done))


def _since(strike: Strike, actor: ActorStatus | None) -> float | None:
    return None if actor is None else max(0.0, actor.heartbeat.timestamp() - strike.at)


def answering_again(at: float, answers: Sequence[tuple[float, bool]]) -> Recovery:
    """When a service that was killed ``at`` answered again, from (time, whether it answered) in order."""
    first = next((time for time, answered in answers if time > at and answered), None)
    down = next((time for time, answered in answers if time > at and not answered), None)
    if down is not None:  # an answer that was under way when it died does not count
        first = next((time for time, answered in answers if time > down and answered), None)
    since = None if first is None else first - at
    return Recovery(since, since)


def summary(strikes: Sequence[Strike], recoveries: Sequence[Recovery]) -> dict[str, dict[str, Any]]:
    """Of each kind of target: how many were killed, how many came back, median and worst of both times."""
    result: dict[str, dict[str, Any]] = {}
    for target in dict.fromkeys(strike.target for strike in strikes):
        found = [each for strike, each in zip(strikes, recoveries, strict=True) if strike.target == target]
        up, working = ([value for value in values if value is not None] for values in _columns(found))
        result[target] = {
            "killed": len(found),
            "back": len(up),
            "up_s": {"median": _middle(up), "worst": max(up, default=None)},
            "working": len(working),
            "working_s": {"median": _middle(working), "worst": max(working, default=None)},
        }
    return result


def _columns(found: Sequence[Recovery]) -> tuple[list[float | None], list[float | None]]:
    return [each.up_s for each in found], [each.working_s for each in found]


def _middle(values: Sequence[float]) -> float | None:
    """The median, the greater of the two in the middle."""
    return sorted(values)[len(values) // 2] if values else None
