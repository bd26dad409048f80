"""What ends standard output does not end the process."""

import io
import os
import subprocess
import sys
import threading

import pytest

from vawm.process import streams

BUFFERED = {name: x for name, x in os.environ.items() if name != "PYTHONUNBUFFERED"}
SCRIPT = """
import sys, time
import rich.console
from vawm.command_line import guard
from vawm.huge_pages import use_huge_pages

use_huge_pages()

def main():
    console = rich.console.Console()
    for number in range(200):
        (console.print if sys.argv[1] == "rich" else print)(f"line {number}")
        if sys.argv[1] != "once":
            sys.stdout.flush()
            time.sleep(0.01)
    sys.stderr.write("the end")
    return 3

sys.exit(guard(main))
"""


@pytest.mark.parametrize("how", ["rich", "print", "once"])
@pytest.mark.parametrize("where", ["pipe", "/dev/full"])
def test_a_program_outlives_its_standard_output(where, how):
    out = subprocess.PIPE if where == "pipe" else open(where, "w")  # noqa: SIM115
    with subprocess.Popen(
        [sys.executable, "-c", SCRIPT, how],
        stdout=out,
        stderr=subprocess.PIPE,
        text=True,
        env=BUFFERED,
    ) as process:
        if where == "pipe" and how != "once":  # where the first to fail is at the end
            assert process.stdout.readline() == "line 0\n"
        (process.stdout or out).close()
        told = process.stderr.read()
        assert process.wait(timeout=60) == 3
    reason = "Broken pipe" if where == "pipe" else "No space left on device"
    parts = [f"warning: standard output is gone ({reason})\n", "the end"]
    assert told == "".join(parts[::-1] if how == "once" else parts)


@pytest.mark.parametrize("closed", [">&-", ">&- 2>&-", "0<&- >&- 2>&-"])
def test_a_program_that_begins_without_them_does_too(closed):
    command = f'"{sys.executable}" -c "$0" once {closed}'
    run = subprocess.run(["sh", "-c", command, SCRIPT], timeout=60, env=BUFFERED)
    assert run.returncode == 3


def test_the_numbers_of_closed_streams_do_not_go_to_files(tmp_path):
    """What compiled code writes to them would be in these."""
    script = """
import os, sys
from vawm import streams
with streams.outlive(), open(sys.argv[1], "w") as file:
    for number in (1, 2):
        os.write(number, b"chatter")
"""
    command = f'"{sys.executable}" -c "$0" {tmp_path}/file 0<&- >&- 2>&-'
    subprocess.run(["sh", "-c", command, script], timeout=60, check=True)
    assert (tmp_path / "file").read_text() == ""


JOBS = """
import pathlib, sys
from vawm.command_line import guard
from vawm.sweep import children

jobs = [
    children.Job(f"job {i}", [sys.executable, "-c", f"print({i})"], pathlib.Path(f"log{i}"))
    for i in range(3)
]
sys.exit(guard(lambda: children.run_then(jobs, lambda: print("done"), at_once=1)))
"""


def test_a_sweep_outlives_its_standard_output(tmp_path):
    with subprocess.Popen(
        [sys.executable, "-c", JOBS], stdout=subprocess.PIPE, cwd=tmp_path, env=BUFFERED
    ) as process:
        process.stdout.close()
        assert process.wait(timeout=60) == 0
    assert [(tmp_path / f"log{i}").read_text() for i in range(3)] == ["0\n", "1\n", "2\n"]


def test_threads_that_lose_it_together_lose_it_once(capsys):
    class Gone(io.StringIO):
        def write(self, text):
            barrier.wait()
            raise BrokenPipeError(32, "Broken pipe")

    def write():
        lengths.append(out.write("text"))

    barrier, lengths = threading.Barrier(4), []
    out = streams.Lasting(Gone(), "standard output")
    threads = [threading.Thread(target=write) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(30)
    assert lengths == [4] * 4
    assert capsys.readouterr().err == "warning: standard output is gone (Broken pipe)\n"


def test_a_pipe_that_is_full_for_a_moment_is_not_gone(capsys):
    class Full(io.StringIO):
        def write(self, text):
            if text == "lost":
                raise BlockingIOError(11, "would block")
            return super().write(text)

    out = streams.Lasting(Full(), "standard output")
    out.writelines(["heard ", "lost", "again"])
    assert (out.getvalue(), capsys.readouterr().err) == ("heard again", "")


def test_what_was_closed_since_takes_everything(capsys):
    file = io.StringIO()
    out = streams.Lasting(file, "standard output")
    assert (out.write("heard"), file.getvalue(), out.isatty()) == (5, "heard", False)
    file.close()
    assert out.write("not heard") == 9
    out.flush()
    told = "warning: standard output is gone (I/O operation on closed file)\n"
    assert capsys.readouterr().err == told


def test_a_pipe_that_stays_full_does_not_cost_the_exit_code():
    script = """
import os, sys
from vawm import streams
os.set_blocking(1, False)
with streams.outlive():
    for _ in range(2000):
        print("x" * 99)
sys.exit(3)
"""
    with subprocess.Popen(
        [sys.executable, "-c", script], stdout=subprocess.PIPE, env=BUFFERED
    ) as process:
        assert process.wait(timeout=60) == 3  # and nobody has read


def test_a_stream_that_was_replaced_inside_stays(monkeypatch):
    monkeypatch.setattr(sys, "stdout", sys.stdout)
    before, other = sys.stderr, io.StringIO()
    with streams.outlive():
        sys.stdout = other
    assert (sys.stdout, sys.stderr) == (other, before)


def test_what_it_cannot_encode_is_still_an_error():
    out = streams.Lasting(io.TextIOWrapper(io.BytesIO(), "ascii"), "standard output")
    with pytest.raises(UnicodeEncodeError):
        out.write("\u00fc")


def test_the_streams_of_before_come_back():
    before = sys.stdout, sys.stderr
    with streams.outlive():
        inside = sys.stdout, sys.stderr
        with streams.outlive():
            assert (sys.stdout, sys.stderr) == inside  # not wrapped twice
    assert (sys.stdout, sys.stderr) == before
