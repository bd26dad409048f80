"""Huge pages for the memory of updates on CPU, kept from one update to the next.

XLA's CPU backend allocates the hundreds of megabytes of an update with malloc and frees them
afterwards. By default glibc returns them to the system, and every update faults all of them
in again in pages of 4 KiB: at size 1m some 90,000 faults, a quarter of its time. With 2 MiB
pages that glibc keeps, almost no faults are left. glibc reads its settings when a process
starts, so a program has to restart itself once.

glibc keeps memory only in the heap of the main thread. It maps a large block for another
thread and returns it when freed. So JAX is told to compute in the thread that calls it.
Without that, an update from pixels takes 1.5 times as long whenever its gigabyte is mapped
again.
"""

from __future__ import annotations

import contextlib
import os
import pathlib
import sys

# Use huge pages; take every block from a heap; never trim a heap; have few heaps, because
# memory that one heap keeps is lost to the others.
TUNABLES = (
    "glibc.malloc.hugetlb=1",
    "glibc.malloc.mmap_max=0",
    "glibc.malloc.trim_threshold=1000000000000",
    "glibc.malloc.arena_max=4",
)
PAGE_SETTING = pathlib.Path("/sys/kernel/mm/transparent_hugepage/enabled")


def use_huge_pages() -> None:
    """Restarts this program with glibc's huge pages on, unless they are on or unavailable.

    For programs only, as their first statement; the library never calls it. Does nothing
    outside Linux, if the kernel does not offer huge pages on request, if `GLIBC_TUNABLES`
    already sets malloc, or if `VAWM_HUGE_PAGES=0`. The process keeps its id, its arguments
    and its terminal.
    """
    tunables = os.environ.get("GLIBC_TUNABLES", "")
    if all(setting in tunables for setting in TUNABLES):  # already restarted
        compute_in_caller()
    if "glibc.malloc." in tunables or not offered():
        return
    if os.environ.get("VAWM_HUGE_PAGES") == "0":
        return
    os.environ["GLIBC_TUNABLES"] = ":".join([*filter(None, [tunables]), *TUNABLES])
    for stream in (sys.stdout, sys.stderr):
        if stream is not None:  # None: it was closed before the process started
            with contextlib.suppress(OSError, ValueError):
                stream.flush()
    os.execv(sys.executable, [sys.executable, *sys.orig_argv[1:]])


def compute_in_caller() -> None:
    """Makes JAX compute on CPU in the calling thread, where glibc keeps memory."""
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
