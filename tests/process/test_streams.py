"""A process survives the loss of its standard output."""

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
from vawm.cli.command_line import guard
from vawm.process.huge_pages import use_huge_pages

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
def test_a_program_survives_the_loss_of_its_standard_output(where, how):
    out = subprocess.PIPE if where == "pipe" else open(where, "w")  # noqa: SIM115
    with subprocess.Popen(
        [sys.executable, "-c", SCRIPT, how],
        stdout=out,
        stderr=subprocess.PIPE,
        text=True,
        env=BUFFERED,
    ) as process:
        if where == "pipe" and how != "once":  # with "once", only the last flush fails
            assert process.stdout.readline() == "line 0\n"
        (process.stdout or out).close()
        told = process.stderr.read()
        assert process.wait(timeout=60) == 3
    reason = "Broken pipe" if where == "pipe" else "No space left on device"
    warning = told.replace("the end", "", 1)
    assert warning.startswith("warning: standard output")
    assert reason in warning
    assert warning.count("\n") == 1
    assert told.startswith("the end") if how == "once" else told.endswith("the end")


@pytest.mark.parametrize("closed", [">&-", ">&- 2>&-", "0<&- >&- 2>&-"])
def test_a_program_that_starts_with_closed_streams_runs(closed):
    command = f'"{sys.executable}" -c "$0" once {closed}'
    run = subprocess.run(["sh", "-c", command, SCRIPT], timeout=60, env=BUFFERED)
    assert run.returncode == 3


def test_files_do_not_get_the_descriptors_of_closed_streams(tmp_path):
    """Otherwise the output of compiled code would end up in the files."""
    script = """
import os, sys
from vawm.process import streams
with streams.outlive(), open(sys.argv[1], "w") as file:
    for number in (1, 2):
        os.write(number, b"chatter")
"""
    command = f'"{sys.executable}" -c "$0" {tmp_path}/file 0<&- >&- 2>&-'
    subprocess.run(["sh", "-c", command, script], timeout=60, check=True)
    assert (tmp_path / "file").read_text() == ""


JOBS = """
import pathlib, sys
from vawm.cli.command_line import guard
from vawm.sweep import children

jobs = [
    children.Job(
        f"job {i}",
        [sys.executable, "-c", f"print({i})"],
        log=pathlib.Path(f"log{i}"),
        folder=pathlib.Path(f"run{i}"),
    )
    for i in range(3)
]
sys.exit(guard(lambda: children.run_then(jobs, lambda: print("done"), at_once=1)))
"""


def test_a_sweep_survives_the_loss_of_its_standard_output(tmp_path):
    with subprocess.Popen(
        [sys.executable, "-c", JOBS], stdout=subprocess.PIPE, cwd=tmp_path, env=BUFFERED
    ) as process:
        process.stdout.close()
        assert process.wait(timeout=60) == 0
    assert [(tmp_path / f"log{i}").read_text() for i in range(3)] == ["0\n", "1\n", "2\n"]


def test_threads_that_fail_together_warn_once(capsys):
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
    assert_one_warning(capsys, "standard output", "Broken pipe")


def assert_one_warning(capsys, name, reason):
    told = capsys.readouterr().err
    assert told.startswith(f"warning: {name}")
    assert reason in told
    assert told.count("\n") == 1


def test_a_pipe_that_is_full_for_a_moment_is_used_again(capsys):
    class Full(io.StringIO):
        def write(self, text):
            if text == "lost":
                raise BlockingIOError(11, "would block")
            return super().write(text)

    out = streams.Lasting(Full(), "standard output")
    out.writelines(["heard ", "lost", "again"])
    assert (out.getvalue(), capsys.readouterr().err) == ("heard again", "")


def test_a_file_that_is_closed_later_drops_all_text(capsys):
    file = io.StringIO()
    out = streams.Lasting(file, "standard output")
    assert (out.write("heard"), file.getvalue(), out.isatty()) == (5, "heard", False)
    file.close()
    assert out.write("not heard") == 9
    out.flush()
    assert_one_warning(capsys, "standard output", "I/O operation on closed file")


def test_a_pipe_that_stays_full_does_not_change_the_exit_code():
    script = """
import os, sys
from vawm.process import streams
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


def test_a_stream_replaced_inside_the_block_stays_replaced(monkeypatch):
    monkeypatch.setattr(sys, "stdout", sys.stdout)
    before, other = sys.stderr, io.StringIO()
    with streams.outlive():
        sys.stdout = other
    assert (sys.stdout, sys.stderr) == (other, before)


@pytest.mark.parametrize(
    ("encoding", "text", "written"),
    [("ascii", "f\u00fcr", b"f\\xfcr"), ("utf-8", "\udcff f\u00fcr", b"\\udcff f\xc3\xbcr")],
)
def test_characters_that_cannot_be_encoded_are_escaped(encoding, text, written):
    file = io.BytesIO()
    out = streams.Lasting(io.TextIOWrapper(file, encoding), "standard output")
    assert out.write(text) == len(text)
    out.flush()
    assert file.getvalue() == written


def test_the_earlier_streams_are_restored():
    before = sys.stdout, sys.stderr
    with streams.outlive():
        inside = sys.stdout, sys.stderr
        with streams.outlive():
            assert (sys.stdout, sys.stderr) == inside  # not wrapped twice
    assert (sys.stdout, sys.stderr) == before
