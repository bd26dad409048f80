"""Keep freed memory in the process, so that updates on CPU do not fault it in again.

XLA's CPU backend takes the hundreds of megabytes that an update works in from malloc and
frees them after it. By default glibc hands such blocks back to the system, and the next
update pays one page fault for every 4 KiB of them: at size 1m about 90,000 faults.
"""

from __future__ import annotations

import ctypes
import os
import sys

# glibc's malloc.h
M_TRIM_THRESHOLD, M_TOP_PAD, M_MMAP_MAX, M_ARENA_MAX = -1, -2, -4, -8
NEVER = 2**31 - 1
TOP_PAD = 64 * 2**20


def keep_memory() -> bool:
    """Tell glibc to serve all blocks from one heap and never to shrink it.

    Works for the whole process and best before other threads start, so only programs call
    it, never the library. `VAWM_KEEP_MEMORY=0` turns it off; it does nothing elsewhere than
    on Linux with glibc.

    Returns:
      Whether the settings were taken.
    """
    if not sys.platform.startswith("linux") or os.environ.get("VAWM_KEEP_MEMORY") == "0":
        return False
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, AttributeError):
        return False
    settings = {M_ARENA_MAX: 1, M_MMAP_MAX: 0, M_TRIM_THRESHOLD: NEVER, M_TOP_PAD: TOP_PAD}
    return all(mallopt(name, value) == 1 for name, value in settings.items())
