"""Runs a command in a terminal of a given width, and shows what one would see there.

    python tests/support/terminal.py 80 python experiments/dmc_proprio.py --logdir LOGDIR
    python tests/support/terminal.py 80 --ctrl-c 20 python ...   # Ctrl-C after 20 seconds

Prints the last rows every few seconds, and all of them at the end.
"""

import argparse
import contextlib
import fcntl
import os
import pty
import re
import select
import struct
import subprocess
import sys
import termios
import time

ROWS = 50
EVERY = 4.0  # seconds between two looks
CODE = re.compile(r"(\x1b\[[0-9;?]*[A-Za-z]|\r|\n)")


def screen(text: str, width: int | None = None) -> list[str]:
    """The rows that a terminal shows after `text`, with the control codes that rich writes.

    With a `width`, a row that is longer continues in the next one.
    """
    rows, at, column = [""], 0, 0

    def down() -> None:
        nonlocal at, column
        at, column = at + 1, 0
        rows.extend([""] * (at + 1 - len(rows)))

    for part in CODE.split(text):
        if part == "\n":
            down()
        elif part == "\r":
            column = 0
        elif part.startswith("\x1b["):
            if part[-1] == "A":
                at = max(0, at - int(part[2:-1] or 1))
            elif part[-1] == "K":
                rows[at] = ""
        else:
            while part:
                if width is not None and column == width:
                    down()
                room = len(part) if width is None else width - column
                head, part = part[:room], part[room:]
                row = rows[at].ljust(column)
                rows[at] = row[:column] + head + row[column + len(head) :]
                column += len(head)
    return [row.rstrip() for row in rows]


def record(words: list[str], columns: int, ctrl_c: float | None = None) -> str:
    """All that `words` writes to a terminal of so many columns."""
    ours, theirs = pty.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", ROWS, columns, 0, 0))
    environ = os.environ | {"TERM": "xterm-256color"}
    process = subprocess.Popen(
        words,
        stdin=theirs,
        stdout=theirs,
        stderr=theirs,
        env=environ,
        start_new_session=True,
        preexec_fn=lambda: fcntl.ioctl(0, termios.TIOCSCTTY, 0),
    )
    os.close(theirs)
    written, began, looked = b"", time.monotonic(), time.monotonic()
    with contextlib.suppress(OSError):  # the terminal closes with its process
        while True:
            if select.select([ours], [], [], 0.2)[0]:
                if not (more := os.read(ours, 1 << 16)):
                    break
                written += more
            now = time.monotonic()
            if ctrl_c is not None and now - began > ctrl_c:
                os.write(ours, b"\x03")  # the terminal echoes it, and sends the signal
                ctrl_c = None
            if now - looked > EVERY:
                looked = now
                rows = screen(written.decode(errors="replace"), columns)
                print(f"--- after {now - began:.0f} s", *rows[-4:], sep="\n", flush=True)
    os.close(ours)
    process.wait()
    return written.decode(errors="replace")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(usage=__doc__)
    parser.add_argument("columns", type=int)
    parser.add_argument("--ctrl-c", type=float)
    parser.add_argument("words", nargs=argparse.REMAINDER)
    arguments = parser.parse_args()
    text = record(arguments.words, arguments.columns, arguments.ctrl_c)
    print("=" * arguments.columns)
    print("\n".join(screen(text, arguments.columns)))
    sys.exit(0)
