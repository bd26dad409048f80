"""The pace of a run: right from the first update on, whatever came before."""

import math

import pytest

from vawm.runs.reports import pace
from vawm.runs.reports.pace import Pace, Totals

PER_ENV_STEP, PER_UPDATE = 0.001, 0.5  # seconds
RATE = 1 / 40  # updates per env step


def play(chunks, *, start=Totals(), of=RATE, before_every=None):  # noqa: B008
    """`Pace` after `chunks` of (env steps, updates)."""
    measured, totals = Pace(of, start), start
    for env_steps, updates in chunks:
        if before_every is not None:
            before_every(measured)
        seconds = PER_ENV_STEP * env_steps + PER_UPDATE * updates
        totals = Totals(
            totals.env_steps + env_steps, totals.updates + updates, totals.seconds + seconds
        )
        measured.reach(totals)
    return measured


def truth(env_steps):
    return env_steps * (PER_ENV_STEP + PER_UPDATE * RATE)


IDLE = [(8, 0)] * 50


def test_before_the_first_update_nothing_is_known():
    measured = play(IDLE)
    assert measured.seconds_for(1000) is None
    assert measured.env_steps_per_s == pytest.approx(1 / PER_ENV_STEP)
    assert measured.updates_per_s == 0.0


@pytest.mark.parametrize("later", [[], [(8, 0), (8, 0)], [(8, 0)] * 4 + [(8, 1)]])
def test_the_first_update_is_enough_also_if_not_every_chunk_has_one(later):
    measured = play([*IDLE, (8, 1), *later])
    assert measured.seconds_for(1000) == pytest.approx(truth(1000))


def test_speeds_are_those_since_learning_began():
    measured = play([*IDLE, (40, 1)])
    seconds = 40 * PER_ENV_STEP + PER_UPDATE
    assert measured.env_steps_per_s == pytest.approx(40 / seconds)
    assert measured.updates_per_s == pytest.approx(1 / seconds)


def test_a_resumed_run_needs_no_chunk_without_updates():
    start = Totals(10_000, 250, 135.0)
    assert play([], start=start).seconds_for(1000) is None
    measured = play([(40, 1)] * 3, start=start)
    assert measured.seconds_for(1000) == pytest.approx(truth(1000))


def test_after_a_day_of_learning_the_estimate_still_holds():
    measured = play([*IDLE, *[(4_000, 100)] * 2_000])  # most memory of idle chunks has faded
    assert measured.seconds_for(1000) == pytest.approx(truth(1000))


def test_a_machine_that_becomes_slower_is_noticed():
    measured = Pace(1.0)
    for seconds in [*range(1, 301), *range(302, 1502, 2)]:  # 1 s, then 2 s per update
        updates = measured._latest.updates + 1
        measured.reach(Totals(updates, updates, seconds))
    faded = math.exp(-1200 / pace.MEMORY_SECONDS)
    assert measured.seconds_for(1) == pytest.approx(2.0, abs=3 * faded)


def test_a_chunk_without_a_step_forward_counts_its_time():
    """As when all environments are reset."""
    measured = Pace(0.5)
    measured.reach(Totals(0, 1, 2.0))
    assert measured.seconds_for(10) == pytest.approx(10.0)
