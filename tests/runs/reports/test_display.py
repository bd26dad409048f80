"""What a run shows on a terminal and in a log file, with a fake clock."""

import contextlib
import io
import re

import pytest
import rich.console
import terminal

from vawm.runs.reports import display as displays
from vawm.runs.reports.display import Display
from vawm.runs.reports.pace import Pace, Totals
from vawm.runs.reports.tracking import Interval

CONTROL = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]")
COLOUR = re.compile(r"\x1b\[(?:3\d|9\d|38)[;m]")
TERMINAL = {"TERM": "xterm-256color"}


class Clock:
    now = 0.0

    def __call__(self):
        return self.now


@pytest.fixture
def clock():
    return Clock()


def console(clock, *, terminal, width=120, environ=None):
    return rich.console.Console(
        file=io.StringIO(),
        force_terminal=terminal,
        width=width,
        get_time=clock,
        _environ=TERMINAL if environ is None else environ,
    )


def screen(console):
    """The rows that the terminal shows."""
    return terminal.screen(console.file.getvalue(), console.width)


def line(env_steps, returns, **more):
    return {
        "env_steps": env_steps,
        "updates": 30,
        "episode/return": returns,
        "env_steps_per_s": 100.0,
        "updates_per_s": 2.5,
    } | more


LOSSES = {
    "loss/dynamics": 1.25,
    "loss/value_alignment": 0.5,
    "loss/critic": 3.0,
    "loss/total": 4.75,
    "value_alignment/loss": 0.625,
    "value_alignment/weight": 0.8,
}


def interval(**losses):
    """One chunk with one update."""
    return Interval(updates=1, weighted=dict(losses), env_steps=1_000, seconds=1.0)


def begun(shown, *, start=Totals(), total=10_000, lines=(), mode="auto"):  # noqa: B008
    display = Display(shown, mode=mode)
    display.begin(start, total=total, pace=Pace(1 / 1_000, start), lines=list(lines))
    return display


def play(display, clock, *, seconds, chunks=3, start=Totals(), updates=1, interval=Interval()):  # noqa: B008
    """1,000 env steps and some updates in every chunk, which takes `seconds`."""
    for chunk in range(1, chunks + 1):
        clock.now += seconds
        totals = Totals(
            start.env_steps + 1_000 * chunk,
            start.updates + updates * chunk,
            start.seconds + seconds * chunk,
        )
        display.advance(totals, interval)


@pytest.mark.parametrize("width", [80, 120])
def test_a_terminal_shows_all_fields_and_no_row_is_as_wide_as_it(clock, width):
    shown = console(clock, terminal=True, width=width)
    with begun(shown, total=1_000_000) as display:
        play(display, clock, seconds=4.0)
        display.log(line(3_000, -12_345.6, **dict.fromkeys(LOSSES, 1234.5678)))
        assert len(screen(shown)) <= 3
    rows = screen(shown)
    text = "\n".join(rows)
    assert max(map(len, rows)) <= width - displays.FREE_COLUMNS
    for field in (
        "3,000/1,000,000 env steps",
        "ETA 1:06:28",
        "return -12345.6",
        "250 env steps/s",
        "0.2 updates/s",
        "world model 2.47e+03",
        "value alignment 1.23e+03 x 1.2e+03",
        "critic 1.23e+03",
    ):
        assert text.count(field) == 1, (field, text)


def test_one_bar_is_left_at_the_end_with_all_texts_above_it(clock):
    shown = console(clock, terminal=True)
    with begun(shown) as display:
        play(display, clock, seconds=3.0, chunks=1)
        display.stopping()
        display.note("saved [a] checkpoint")
        play(display, clock, seconds=3.0, chunks=2)
    rows = screen(shown)
    assert rows[:2] == ["stopping after this step ...", "saved [a] checkpoint"]
    assert sum("env steps  " in row for row in rows) == 1
    assert "2,000/10,000 env steps" in rows[2]


def test_a_key_that_the_terminal_echoes_leaves_no_second_bar(clock):
    """`^C` at the end of the last row fits into it."""
    shown = console(clock, terminal=True, width=80)
    with begun(shown) as display:
        display.log(line(0, 1.0, **LOSSES))
        assert max(map(len, screen(shown))) + len("^C") < 80


def test_before_the_first_update_a_terminal_says_that_it_does_not_learn(clock):
    shown = console(clock, terminal=True)
    with begun(shown) as display:
        play(display, clock, seconds=2.0, chunks=1, updates=0)
    text = "\n".join(screen(shown))
    assert "ETA -" in text
    assert "return -   500 env steps/s   not learning yet" in text


def test_losses_are_shown_before_the_first_line(clock):
    shown = console(clock, terminal=True)
    with begun(shown) as display:
        play(display, clock, seconds=1.0, chunks=1, interval=interval(**LOSSES))
    text = "\n".join(screen(shown))
    assert "world model 1.75   value alignment 0.625 x 0.8   critic 3" in text


@pytest.mark.parametrize("seconds", [0.01, 120.0])
def test_chunks_of_any_length_give_an_eta_and_the_time_before_does_not_count(clock, seconds):
    shown = console(clock, terminal=True)
    with begun(shown) as display:
        clock.now += 500.0
        play(display, clock, seconds=seconds)
    remaining = "0:00:00" if seconds == 0.01 else "0:14:00"
    assert f"ETA {remaining}" in screen(shown)[0]


def test_the_eta_counts_down_while_a_step_takes_long(clock):
    shown = console(clock, terminal=True)
    with begun(shown) as display:
        play(display, clock, seconds=60.0)
        clock.now += 25.0
    assert "ETA 0:06:35" in screen(shown)[0]


def test_a_resumed_run_covers_the_remaining_steps_and_knows_its_last_return(clock):
    start = Totals(5_000, 5, 10.0)
    lines = [line(4_000, 17.25, **LOSSES), line(5_000, None)]
    shown = console(clock, terminal=True)
    with begun(shown, start=start, lines=lines) as display:
        assert "return 17.2" in "\n".join(screen(shown))
        assert "not learning" not in "\n".join(screen(shown))
        play(display, clock, seconds=2.0, start=start)
    text = "\n".join(screen(shown))
    assert "8,000/10,000 env steps" in text
    assert "ETA 0:00:04" in text
    assert "return 17.2" in text
    assert "critic 3" in text
    plain = console(clock, terminal=False)
    with begun(plain, start=start, lines=lines):
        pass
    assert plain.file.getvalue() == "last episode return 17.2\n"


def test_a_finished_run_is_not_shown_beyond_its_end(clock):
    shown = console(clock, terminal=True)
    with begun(shown, total=2_500) as display:
        play(display, clock, seconds=2.0)
        clock.now += 30.0  # saving
    assert "100%  2,500/2,500 env steps  took 0:00:06" in screen(shown)[0]


def test_a_log_file_has_one_line_per_line_of_metrics(clock):
    shown = console(clock, terminal=False)
    with Display(shown) as display:
        with display.busy("compiling", done="compiled", hint="[a minute]"):
            clock.now += 12.5
        display.begin(Totals(), total=10_000, pace=Pace(1 / 1_000), lines=[])
        play(display, clock, seconds=3.0, chunks=1, updates=0)
        display.log(line(1_000, None) | {"updates": 0, "updates_per_s": 0.0})
        play(display, clock, seconds=3.0, chunks=4)
        display.log(line(4_000, 12.34, **LOSSES))
        display.log(line(10_016, None))
    assert shown.file.getvalue().splitlines() == [
        "compiling ([a minute]) ...",
        "compiled in 12.5 s",
        "env_steps 1000/10000  updates 0  return -  100 env steps/s  0.0 updates/s  "
        "not learning yet",
        "env_steps 4000/10000  updates 30  return 12.3  world model 1.75  "
        "value alignment 0.625 x 0.8  critic 3  100 env steps/s  2.5 updates/s  ETA 0:00:18",
        "env_steps 10016/10000  updates 30  return -  100 env steps/s  2.5 updates/s  "
        "ETA 0:00:18",
    ]


def test_a_terminal_shows_for_how_long_it_compiles_and_then_only_how_long_it_took(clock):
    shown = console(clock, terminal=True)
    with Display(shown) as display:
        with display.busy("compiling", done="compiled"):
            clock.now += 12.0
            display._live.refresh()
            assert screen(shown)[-1].endswith("compiling 12 s")
            display.stopping()
        display.begin(Totals(), total=10_000, pace=Pace(1.0), lines=[])
    rows = screen(shown)
    assert "waits for compiling" in rows[0]
    assert rows[1] == "compiled in 12.0 s"
    assert not any("compiling 12 s" in row for row in rows)
    assert "0/10,000 env steps" in rows[2]


HEAD = "dreamerv3: " + "words " * 15 + "end\n  indented " + "words " * 15 + "end"


@pytest.mark.parametrize("width", [80, 120])
def test_what_a_run_is_breaks_between_words_on_a_terminal_and_not_in_a_file(clock, width):
    shown = console(clock, terminal=True, width=width)
    Display(shown).head(HEAD)
    rows = screen(shown)[:-1]
    assert len(rows) == (4 if width == 80 else 2)
    assert max(map(len, rows)) <= width
    assert " ".join(" ".join(rows).split()) == " ".join(HEAD.split())
    assert rows[-1].startswith("    " if width == 80 else "  ")
    plain = console(clock, terminal=False, width=width)
    Display(plain).head(HEAD)
    assert plain.file.getvalue() == HEAD + "\n"


def test_what_ends_before_training_leaves_no_bar_and_no_spinner(clock):
    shown = console(clock, terminal=True)
    with Display(shown) as display, contextlib.suppress(KeyboardInterrupt):
        display.note("logdir: here")
        with display.busy("compiling", done="compiled"):
            raise KeyboardInterrupt
    assert [row for row in screen(shown) if row] == ["logdir: here"]
    written = shown.file.getvalue()
    assert written.rindex(displays.SHOW_CURSOR) > written.rindex("\x1b[?25l")


def test_plain_writes_no_control_codes_and_quiet_only_warnings(clock, monkeypatch, capsys):
    monkeypatch.setenv("FORCE_COLOR", "1")
    printed = {}
    for mode in ("plain", "quiet"):
        with begun(None, mode=mode) as display:
            display.note("a note")
            display.warn("warning: a disk")
            with display.busy("compiling", done="compiled", hint="a minute"):
                pass
            play(display, clock, seconds=3.0)
            display.log(line(3_000, 1.0))
            display.stopping()
        printed[mode] = capsys.readouterr().out
    assert "\x1b" not in printed["plain"]
    assert printed["plain"].count("\n") == 6
    assert CONTROL.sub("", printed["quiet"]) == "warning: a disk\n"


@pytest.mark.parametrize(
    ("environ", "coloured"),
    [({}, True), ({"NO_COLOR": "1"}, False), ({"TERM": "dumb"}, False)],
)
def test_a_terminal_without_colour_gets_none(clock, environ, coloured):
    shown = console(clock, terminal=True, environ=TERMINAL | environ)
    with begun(shown) as display:
        display.warn("warning: a disk")
        play(display, clock, seconds=3.0)
    assert bool(COLOUR.search(shown.file.getvalue())) == coloured


def test_a_dumb_terminal_gets_lines_instead_of_a_bar(clock):
    shown = console(clock, terminal=True, environ={"TERM": "dumb"})
    with begun(shown) as display:
        play(display, clock, seconds=3.0)
        display.log(line(3_000, 1.0))
    assert shown.file.getvalue().startswith("env_steps 3000/10000  ")
    assert "\x1b" not in shown.file.getvalue()


def test_colour_is_forced_into_a_pipe_but_no_bar(monkeypatch, capsys, clock):
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.delenv("NO_COLOR", raising=False)
    with begun(None) as display:
        display.warn("warning: a disk")
        play(display, clock, seconds=3.0)
    printed = capsys.readouterr().out
    assert COLOUR.search(printed)
    assert printed.count("\n") == 1
    assert displays.SHOW_CURSOR not in printed


def test_a_bar_can_be_asked_for_where_there_is_no_terminal(monkeypatch, capsys, clock):
    monkeypatch.setenv("TERM", "xterm")
    with begun(None, mode="bar") as display:
        play(display, clock, seconds=3.0)
    assert "3,000/10,000 env steps" in capsys.readouterr().out


def test_a_process_that_is_ended_gives_the_cursor_back(clock):
    shown = console(clock, terminal=True)
    with begun(shown) as display:
        before = len(shown.file.getvalue())
        display.release()
        assert displays.SHOW_CURSOR in shown.file.getvalue()[before:]
    plain = console(clock, terminal=False)
    with begun(plain) as display:
        display.release()
    assert not plain.file.getvalue()
