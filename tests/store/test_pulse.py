"""How old a heartbeat is, whatever the clocks of two machines say."""

from datetime import UTC, datetime, timedelta

import pytest

from service.store.models import Pulse
from tests.clock import Clock
from tests.store.stores import a_status


@pytest.fixture
def clock():
    return Clock()


@pytest.fixture
def pulse(clock):
    return Pulse(clock)


def ago(seconds):
    return datetime.now(UTC) - timedelta(seconds=seconds)


def age_s(pulse, heartbeat, run_id="cube"):
    return pulse.look(a_status(run_id, heartbeat=heartbeat))[1]


def test_at_first_it_is_as_old_as_the_clocks_say_and_then_grows_by_our_own(pulse, clock):
    beat = ago(10)
    assert age_s(pulse, beat) == pytest.approx(10.0, abs=1.0)
    clock.now_s += 50.0
    assert age_s(pulse, beat) == pytest.approx(60.0, abs=1.0)
    assert age_s(pulse, beat, "other") == pytest.approx(10.0, abs=1.0)


def test_one_from_the_future_grows_old_like_any_other(pulse, clock):
    beat = ago(-3600)
    assert age_s(pulse, beat) == 0.0
    clock.now_s += 61.0
    assert age_s(pulse, beat) == 61.0


def test_a_new_one_is_not_older_than_our_last_look(pulse, clock):
    age_s(pulse, ago(5))
    clock.now_s += 2.0
    assert age_s(pulse, ago(3600)) == 2.0  # the clock of its machine is an hour slow, and it beats
    clock.now_s += 3600.0
    assert age_s(pulse, ago(1000)) == pytest.approx(1000.0, abs=1.0)  # it beat while nobody looked


def test_a_heartbeat_from_the_future_says_that_a_clock_is_wrong():
    assert [Pulse().look(a_status(heartbeat=ago(age)))[0].condition for age in (60, -3, -60)] == [
        "well",
        "well",
        "clock",
    ]
    assert "is 60 s in the future" in Pulse().look(a_status(heartbeat=ago(-60.4)))[0].warnings[0]
    assert Pulse().look(a_status(heartbeat=ago(-60), state="finished"))[0].condition == "well"


def test_a_heartbeat_that_comes_late_says_that_a_clock_is_wrong(pulse, clock):
    def look(age_s, **more):
        seen, _ = pulse.look(a_status(heartbeat=ago(age_s), **more))
        return seen.condition, seen.warnings

    assert look(3600) == ("well", ())  # nobody knows for how long it has been there
    clock.now_s += 10.0
    condition, (said,) = look(3609)
    assert condition == "clock"
    assert "is 3599 s in the past as it comes: the clock of its machine, or the one here, is wrong" in said
    clock.now_s += 300.0
    assert look(250) == ("well", ())  # the clock was set, and it beat while nobody looked
    clock.now_s += 1.0
    assert look(3600, state="finished") == ("well", ())


def test_a_clock_is_wrong_until_another_heartbeat_comes(pulse, clock):
    for heartbeat, condition in ((ago(3600), "well"), (beat := ago(3500), "clock"), (beat, "clock"), (ago(0), "well")):
        assert pulse.look(a_status(heartbeat=heartbeat))[0].condition == condition
        clock.now_s += 1.0
