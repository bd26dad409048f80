"""The first signal asks a run to stop, the second kills it, even inside a long call."""

import os
import pathlib
import signal
import subprocess
import sys
import threading
import time

import pytest

from vawm.process import signals


@pytest.fixture(autouse=True)
def usual_handlers():
    """Of a process in a terminal, which children inherit: `nohup` and `&` ignore some."""
    usual = dict.fromkeys(signals.SIGNALS, signal.SIG_DFL)
    usual[signal.SIGINT] = signal.default_int_handler
    before = {number: signal.signal(number, handler) for number, handler in usual.items()}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


SCRIPT = """
import ctypes, sys
from vawm.process import signals
last = lambda: print("last words", flush=True)
with signals.catch(lambda: print("asked", flush=True), at_end=last) as stop:
    print("ready", flush=True)
    libc = ctypes.CDLL(None)
    for _ in range(600):  # a call of compiled code that signals do not end
        libc.usleep(100_000)
        if sys.argv[1] != "twice" and stop.signal:
            libc.usleep(200_000)
            break
print("in order", flush=True)
sys.exit(stop.exit_code)
"""


@pytest.mark.parametrize(
    ("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGHUP, 129)]
)
@pytest.mark.parametrize("times", ["once", "in a burst", "twice"])
def test_signals_end_a_process_with_the_code_that_shells_expect(number, code, times):
    process = subprocess.Popen(
        [sys.executable, "-c", SCRIPT, times], stdout=subprocess.PIPE, text=True
    )
    assert process.stdout.readline() == "ready\n"
    process.send_signal(number)
    assert process.stdout.readline() == "asked\n"
    if times == "twice":
        time.sleep(1.2 * signals.BURST_SECONDS)
    if times != "once":
        process.send_signal(number)
    assert process.wait(timeout=30) == code
    assert process.stdout.read() == ("last words\n" if times == "twice" else "in order\n")
    process.stdout.close()


def test_the_earlier_handlers_are_restored():
    before = signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)
    heard = threading.Event()
    with signals.catch(heard.set) as stop:
        os.kill(os.getpid(), signal.SIGTERM)
        assert heard.wait(10)
        assert stop.signal == signal.SIGTERM
    assert (signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)) == before
    assert stop.exit_code == 143


def test_sighup_stays_ignored_and_sigint_does_not():
    """`nohup` ignores SIGHUP; scripts ignore SIGINT for what they start with `&`."""
    numbers = signal.SIGHUP, signal.SIGINT
    before = [signal.signal(number, signal.SIG_IGN) for number in numbers]
    try:
        with signals.catch() as stop:
            for number in numbers:
                os.kill(os.getpid(), number)
            wait_for(lambda: stop.signal is not None)
            assert stop.signal == signal.SIGINT
        assert [signal.getsignal(number) for number in numbers] == [signal.SIG_IGN] * 2
    finally:
        for number, handler in zip(numbers, before, strict=True):
            signal.signal(number, handler)


def test_a_notice_that_cannot_be_printed_does_not_stop_the_listener():
    def notice():
        raise ValueError("the terminal is closed")

    with signals.catch(notice) as stop:
        os.kill(os.getpid(), signal.SIGHUP)
        wait_for(lambda: stop.signal is not None)
        time.sleep(0.1)
        listening = [t for t in threading.enumerate() if "listen" in t.name]
        assert [thread.is_alive() for thread in listening] == [True]


def wait_for(condition):
    end = time.monotonic() + 10
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.01)


def test_outside_the_main_thread_nothing_is_caught():
    def work():
        with signals.catch() as stop:
            codes.append(stop.exit_code)

    codes = []
    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert codes == [0]


def test_these_tests_pass_under_nohup_and_in_the_background():
    """There, SIGHUP and SIGINT are ignored by inheritance."""
    tests = ("once", "notice", "earlier", "stays_ignored")
    words = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "-k", " or ".join(tests)]
    done = subprocess.run(
        ["sh", "-c", 'trap "" HUP INT; exec "$@"', "sh", *words, __file__],
        capture_output=True,
        text=True,
        cwd=pathlib.Path(__file__).parents[2],
    )
    assert done.returncode == 0, done.stdout
    assert "6 passed" in done.stdout
