import numpy as np
import pytest

from service.learner.replay import Indices, ReplayBuffer

NUM_STEPS, NUM_WORLDS = 7, 2


def filled(num_added, ends=(), num_steps=NUM_STEPS):
    """A buffer whose column ``at`` holds (step, world); ``ends`` has the (step, world) at which an episode ended."""
    replay = ReplayBuffer(num_steps, NUM_WORLDS, {"at": 2})
    for step in range(num_added):
        at = np.float32([[step, world] for world in range(NUM_WORLDS)])
        replay.add({"at": at}, np.array([(step, world) in ends for world in range(NUM_WORLDS)]))
    return replay


def test_it_keeps_the_newest_steps():
    replay, rng = filled(10), np.random.default_rng(0)
    places = replay.draw(500, rng)
    assert set(zip(*places, strict=True)) == {(step, world) for step in range(3, 10) for world in range(2)}
    np.testing.assert_array_equal(replay.read(places)["at"], np.stack(places, axis=1))
    np.testing.assert_array_equal(replay.column("at", places), np.stack(places, axis=1))


def test_it_draws_all_alike():
    step, world = filled(5).draw(20_000, np.random.default_rng(0))
    counts = np.bincount(step * 2 + world)
    assert len(counts) == 10
    np.testing.assert_allclose(counts, 2_000, atol=5 * np.sqrt(2_000))


@pytest.mark.parametrize(
    ("num_added", "end", "step", "world", "later"),
    [
        (5, 2, 0, 0, {0, 1, 2}),  # its episode ended at 2
        (5, 2, 2, 0, {2}),
        (5, 2, 3, 0, {3, 4}),  # goes on: what there is so far
        (5, 2, 0, 1, {0, 1, 2, 3, 4}),
        (11, 9, 8, 0, {8, 9}),  # of its episode 3 to 9 are kept, and step 10 takes the place of 3
        (11, 9, 10, 0, {10}),
        (20, 19, 17, 0, {17, 18, 19}),  # its episode is longer than the buffer
    ],
)
def test_later_places_are_of_the_same_episode(num_added, end, step, world, later):
    replay = filled(num_added, ends={(end, 0)})
    places = Indices(np.full(300, step), np.full(300, world))
    found = replay.draw_later(places, np.random.default_rng(0))
    assert set(found.step.tolist()) == later
    assert set(found.world.tolist()) == {world}


@pytest.mark.parametrize("num_added", [4, 12])
def test_a_restored_buffer_goes_on_as_the_first(num_added):
    first = filled(num_added, ends={(1, 0), (8, 1)})
    second = ReplayBuffer(NUM_STEPS, NUM_WORLDS, {"at": 2})
    second.load_state(first.state())
    for replay in (first, second):
        replay.add({"at": np.ones((2, 2), np.float32)}, np.array([True, False]))
    rngs = [np.random.default_rng(0) for _ in range(2)]
    drawn = [replay.draw(200, rng) for replay, rng in zip((first, second), rngs, strict=True)]
    np.testing.assert_array_equal(drawn[0], drawn[1])
    later = [replay.draw_later(drawn[0], rng) for replay, rng in zip((first, second), rngs, strict=True)]
    np.testing.assert_array_equal(later[0], later[1])
    np.testing.assert_array_equal(first.read(drawn[0])["at"], second.read(drawn[0])["at"])
    assert first.num_added == second.num_added == num_added + 1


@pytest.mark.parametrize(("num_steps", "kept"), [(4, range(6, 10)), (20, range(3, 10))])
def test_a_buffer_of_another_size_takes_the_newest_steps(num_steps, kept):
    """The total of a run may change when it is resumed, and with it what is kept."""
    first, second = filled(10, ends={(8, 0)}), ReplayBuffer(num_steps, NUM_WORLDS, {"at": 2})
    second.load_state(first.state())
    step, world = (each.ravel() for each in np.meshgrid(list(kept), range(NUM_WORLDS)))
    places = Indices(step, world)
    np.testing.assert_array_equal(second.read(places)["at"], np.stack(places, axis=1))
    again = ReplayBuffer(20, NUM_WORLDS, {"at": 2})
    again.load_state(second.state())  # it was stopped, and goes on once more
    for replay in (second, again):  # nothing is drawn that it never had
        assert set(replay.draw(500, np.random.default_rng(0)).step.tolist()) == set(kept)
    later = second.draw_later(Indices(np.full(99, 7), np.zeros(99, dtype=int)), np.random.default_rng(0))
    assert set(later.step.tolist()) == {7, 8}
