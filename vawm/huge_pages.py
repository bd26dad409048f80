"""Huge pages for the memory that updates on CPU work in.

XLA's CPU backend takes the hundreds of megabytes of an update from malloc and gives them
back after it, so every update faults all of them in again: at size 1m about 90,000 pages
of 4 KiB, a quarter of its time. With pages of 2 MiB some 700 faults remain. glibc decides
on its page size when a process starts, so a program has to start itself once more.
"""

from __future__ import annotations

import os
import pathlib
import sys

TUNABLE = "glibc.malloc.hugetlb"
PAGE_SETTING = pathlib.Path("/sys/kernel/mm/transparent_hugepage/enabled")


def use_huge_pages() -> None:
    """Restart this program with glibc's huge pages on, unless they are or cannot be.

    For programs only, as their first act: the library never calls it. Does nothing
    elsewhere than on Linux, where the system does not offer huge pages on request, or
    under `VAWM_HUGE_PAGES=0`. The process keeps its id, its arguments and its terminal.
    """
    tunables = os.environ.get("GLIBC_TUNABLES", "")
    if TUNABLE in tunables or not offered() or os.environ.get("VAWM_HUGE_PAGES") == "0":
        return
    setting = f"{TUNABLE}=1"
    os.environ["GLIBC_TUNABLES"] = f"{tunables}:{setting}" if tunables else setting
    sys.stdout.flush()
    sys.stderr.flush()
    os.execv(sys.executable, [sys.executable, *sys.orig_argv[1:]])


def offered() -> bool:
    """Whether the kernel gives huge pages to programs that ask for them."""
    if not sys.platform.startswith("linux"):
        return False
    try:
        return "[madvise]" in PAGE_SETTING.read_text()
    except OSError:
        return False
