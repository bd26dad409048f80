"""The progress display on a terminal and in a log file, with a fake clock."""

import io
import re

import pytest
import rich.console

from vawm.runs.reports.display import Display
from vawm.runs.reports.tracking import Interval

CONTROL = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]")


class Clock:
    now = 0.0

    def __call__(self):
        return self.now


@pytest.fixture
def clock():
    return Clock()


def console(clock, *, terminal):
    return rich.console.Console(
        file=io.StringIO(), force_terminal=terminal, width=120, get_time=clock
    )


def text(console):
    """The written text, without the control codes of a terminal."""
    return CONTROL.sub("", console.file.getvalue())


def line(env_steps, returns):
    return {
        "env_steps": env_steps,
        "updates": 30,
        "episode/return": returns,
        "env_steps_per_s": 100.0,
        "updates_per_s": 2.5,
    }


def interval(seconds):
    return Interval(env_steps=2_400, updates=6, seconds=seconds)


def play(display, clock, *, seconds, chunks=3, start=0):
    """1,000 env steps in every chunk, which takes `seconds`."""
    for chunk in range(1, chunks + 1):
        clock.now += seconds
        display.advance(start + 1_000 * chunk, interval(seconds))


def test_a_terminal_shows_progress_speed_and_remaining_time(clock):
    shown = console(clock, terminal=True)
    with Display(shown, start=0, total=10_000) as display:
        display.log(line(1_000, 12.34))
        display.log(line(2_000, None))  # no episode ended: the latest return stays
        play(display, clock, seconds=3.0)
    last = text(shown).splitlines()[-1]
    assert "3,000/10,000 env steps" in last
    assert "800/s  2.0 updates/s" in last
    assert "return 12.3" in last
    assert last.rstrip().endswith("0:00:21")  # 7 chunks of 3 seconds


def test_a_terminal_knows_neither_speed_nor_return_at_first(clock):
    shown = console(clock, terminal=True)
    with Display(shown, start=0, total=10_000) as display:
        display.advance(1_000, Interval())
    assert re.search(r"1,000/10,000 env steps +return - +-:--:--", text(shown))


@pytest.mark.parametrize("seconds", [0.01, 120.0])
def test_chunks_of_any_length_give_an_eta_and_compiling_does_not_count(clock, seconds):
    shown = console(clock, terminal=True)
    with Display(shown, start=0, total=10_000) as display:
        clock.now += 500.0
        play(display, clock, seconds=seconds)
    remaining = "0:00:01" if seconds == 0.01 else "0:14:00"
    assert text(shown).rstrip().endswith(remaining)


def test_the_eta_of_a_resumed_run_covers_the_remaining_steps(clock):
    shown = console(clock, terminal=True)
    with Display(shown, start=5_000, total=10_000) as display:
        play(display, clock, seconds=2.0, start=5_000)
    last = text(shown).splitlines()[-1]
    assert "8,000/10,000 env steps" in last
    assert last.rstrip().endswith("0:00:04")


def test_a_finished_run_is_not_shown_beyond_its_end(clock):
    shown = console(clock, terminal=True)
    with Display(shown, start=0, total=2_500) as display:
        play(display, clock, seconds=2.0)
    assert "2,500/2,500 env steps" in text(shown).splitlines()[-1]


def test_a_log_file_has_one_line_per_line_of_metrics(clock):
    shown = console(clock, terminal=False)
    with Display(shown, start=0, total=10_000) as display:
        display.note("compiling [1/2] ...")
        display.log(line(1_000, None) | {"updates": 0})
        play(display, clock, seconds=3.0)
        display.log(line(4_000, 12.34))
        display.log(line(10_016, None))
    assert shown.file.getvalue().strip().splitlines() == [
        "compiling [1/2] ...",
        "env_steps 1000/10000  updates 0  return -  100 steps/s  2.5 updates/s  "
        "not learning yet",
        "env_steps 4000/10000  updates 30  return 12.3  100 steps/s  2.5 updates/s  1 min left",
        "env_steps 10016/10000  updates 30  return -  100 steps/s  2.5 updates/s  0 min left",
    ]


def test_a_note_stays_above_the_bar(clock):
    shown = console(clock, terminal=True)
    with Display(shown, start=0, total=10_000) as display:
        display.note("stopping [now] ...")
        play(display, clock, seconds=3.0)
    rows = text(shown).splitlines()
    assert any(row.startswith("stopping [now] ...") for row in rows)
    assert "env steps" in rows[-1]
