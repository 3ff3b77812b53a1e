"""A rollout as flat arrays, and back."""

from dataclasses import fields, replace

from service.actors.rollout import Demonstrations, Turns, from_arrays, to_arrays
from service.base import tensors
from service.generator.records import GoalRecords
from tests.actors.players import AT_REST, IN_FRONT, SLIDES, Pusher, assert_same_rollout, make_config, make_game, play

PARTS = {"alice": Turns, "bob": Turns, "demonstrations": Demonstrations, "records": GoalRecords}
NUMBERS = ("actor", "incarnation", "sequence", "policy_version", "num_env_steps")


def make_rollout():
    """All verdicts of interest, demonstrations among them; every number differs from every other."""
    game = make_game(make_config(3), [IN_FRONT, AT_REST, SLIDES], actor=5, incarnation=7)
    play(game, Pusher())
    return replace(play(game, Pusher(), version=11), metrics={"alice/contact_fraction": 1 / 3, "alice/x": 0.0})


def test_round_trip_through_the_bytes_of_a_checkpoint():
    rollout = make_rollout()
    arrays = to_arrays(rollout)
    expected = {f"{part}/{field.name}" for part, kind in PARTS.items() for field in fields(kind)}
    assert set(arrays) == expected | set(NUMBERS) | {"metrics/alice/contact_fraction", "metrics/alice/x"}
    again = from_arrays(tensors.decode(tensors.encode(arrays)))
    assert_same_rollout(again, rollout)
    assert (again.id, again.policy_version) == ((5, 7, 1), 11)
    assert again.metrics == rollout.metrics
    for name in NUMBERS:
        assert type(getattr(again, name)) is int
        assert getattr(again, name) == getattr(rollout, name)
    for part, kind in PARTS.items():
        assert type(getattr(again, part)) is kind
