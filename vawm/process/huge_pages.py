"""Huge pages for the memory that updates on CPU work in, kept from one update to the next.

XLA's CPU backend takes the hundreds of megabytes of an update from malloc and gives them
back after it. By default glibc hands them on to the system, and every update faults all of
them in again in pages of 4 KiB: at size 1m some 90,000 faults, a quarter of its time. With
pages of 2 MiB that glibc keeps, hardly a fault is left. glibc reads its settings when a
process starts, so a program has to start itself once more.

It keeps them in the heap of the main thread only: a large block that another thread asks for
is mapped, and given back. So JAX is told to compute in the thread that calls it. Without that
an update from pixels takes half as long again, whenever its gigabyte is mapped anew.
"""

from __future__ import annotations

import contextlib
import os
import pathlib
import sys

# Huge pages; every block from a heap, which is never trimmed; few heaps, as memory that
# one of them keeps is lost to the others.
TUNABLES = (
    "glibc.malloc.hugetlb=1",
    "glibc.malloc.mmap_max=0",
    "glibc.malloc.trim_threshold=1000000000000",
    "glibc.malloc.arena_max=4",
)
PAGE_SETTING = pathlib.Path("/sys/kernel/mm/transparent_hugepage/enabled")


def use_huge_pages() -> None:
    """Restart this program with glibc's huge pages on, unless they are or cannot be.

    For programs only, as their first act: the library never calls it. Does nothing
    elsewhere than on Linux, where the system does not offer huge pages on request, where
    `GLIBC_TUNABLES` already sets malloc, or under `VAWM_HUGE_PAGES=0`. The process keeps
    its id, its arguments and its terminal.
    """
    tunables = os.environ.get("GLIBC_TUNABLES", "")
    if all(setting in tunables for setting in TUNABLES):  # this is the second time
        compute_in_caller()
    if "glibc.malloc." in tunables or not offered():
        return
    if os.environ.get("VAWM_HUGE_PAGES") == "0":
        return
    os.environ["GLIBC_TUNABLES"] = ":".join([*filter(None, [tunables]), *TUNABLES])
    for stream in (sys.stdout, sys.stderr):
        if stream is not None:  # as where it was closed before this began
            with contextlib.suppress(OSError, ValueError):
                stream.flush()
    os.execv(sys.executable, [sys.executable, *sys.orig_argv[1:]])


def compute_in_caller() -> None:
    """Has JAX compute on CPU in the thread that calls it, where memory is kept."""
    import jax

    jax.config.update("jax_cpu_enable_async_dispatch", False)


def offered() -> bool:
    """Whether the kernel gives huge pages to programs that ask for them."""
    if not sys.platform.startswith("linux"):
        return False
    try:
        return "[madvise]" in PAGE_SETTING.read_text()
    except OSError:
        return False
