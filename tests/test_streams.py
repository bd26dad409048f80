"""What ends standard output does not end the process."""

import io
import subprocess
import sys

import pytest

from vawm import streams

SCRIPT = """
import sys, time
import rich.console
from vawm.command_line import guard

def main():
    console = rich.console.Console()
    for number in range(200):
        (console.print if sys.argv[1] == "rich" else print)(f"line {number}")
        sys.stdout.flush()
        time.sleep(0.01)
    sys.stderr.write("the end")
    return 3

sys.exit(guard(main))
"""


@pytest.mark.parametrize("how", ["rich", "print"])
@pytest.mark.parametrize("where", ["pipe", "/dev/full"])
def test_a_program_outlives_its_standard_output(where, how):
    out = subprocess.PIPE if where == "pipe" else open(where, "w")  # noqa: SIM115
    with subprocess.Popen(
        [sys.executable, "-c", SCRIPT, how], stdout=out, stderr=subprocess.PIPE, text=True
    ) as process:
        if where == "pipe":
            assert process.stdout.readline() == "line 0\n"
        (process.stdout or out).close()
        told = process.stderr.read()
        assert process.wait(timeout=60) == 3
    reason = "Broken pipe" if where == "pipe" else "No space left on device"
    assert told == f"warning: standard output is gone ({reason})\nthe end"


@pytest.mark.parametrize("closed", [">&-", ">&- 2>&-"])
def test_a_program_that_begins_without_them_does_too(closed):
    command = f'"{sys.executable}" -c "$0" rich {closed}'
    assert subprocess.run(["sh", "-c", command, SCRIPT], timeout=60).returncode == 3


def test_what_was_closed_since_takes_everything(capsys):
    file = io.StringIO()
    out = streams.Lasting(file, "standard output")
    assert (out.write("heard"), file.getvalue(), out.isatty()) == (5, "heard", False)
    file.close()
    assert out.write("not heard") == 9
    out.flush()
    told = "warning: standard output is gone (I/O operation on closed file)\n"
    assert capsys.readouterr().err == told


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
