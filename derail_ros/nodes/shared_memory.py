"""Removes the shared memory of killed processes."""

from __future__ import annotations

import contextlib
import os
import re
import time
from pathlib import Path

try:
    import fcntl
except ImportError:  # no POSIX, and no shared memory of this kind
    fcntl = None  # type: ignore[assignment]

SHARED_MEMORY = Path("/dev/shm")
SEGMENT_LOCK = re.compile(r"(fastdds_[0-9a-f]{16})_el")
YOUNG = 5.0
"""Age up to which a segment is left alone: its process may be about to lock it, s."""


def sweep(folder: Path = SHARED_MEMORY) -> int:
    """Remove segments of Fast DDS that belong to no process; returns their number.

    A process holds the lock of its segment (half a megabyte) until it ends, however it ends.
    Fast DDS itself removes the segment of a killed process only if another process that knew it
    is still running.
    """
    if fcntl is None or not folder.is_dir():
        return 0
    removed = 0
    for lock in folder.iterdir():
        found = SEGMENT_LOCK.fullmatch(lock.name)
        if found is None:
            continue
        # The lock may be another user's, be held, or vanish meanwhile.
        with contextlib.suppress(OSError), lock.open("rb") as stream:
            if time.time() - os.fstat(stream.fileno()).st_mtime < YOUNG:
                continue
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
            (folder / found[1]).unlink(missing_ok=True)
            lock.unlink()
            removed += 1
    return removed
