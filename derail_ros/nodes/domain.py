"""A ROS domain of its own for a graph that is to hear nobody else."""

from __future__ import annotations

import contextlib
import os
import socket
import tempfile
from collections.abc import Iterator
from pathlib import Path

try:
    import fcntl
except ImportError:  # no POSIX: the ports alone tell
    fcntl = None  # type: ignore[assignment]

DOMAINS = 101
"""Domains 1 to 101 keep clear of the ports that the system gives out to programs."""


def in_use(domain: int) -> bool:
    """Whether a participant of this machine is in a domain.

    The first one has UDP port 7400 + 250 domain + 10 (DDSI-RTPS 2.5, 9.6.2.3) for itself.
    """
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind(("", 7410 + 250 * domain))
        except OSError:
            return True
    return False


def _claim(domain: int) -> int | None:
    """Lock a domain; the lock's file, or None if another graph has or asks for it."""
    path = Path(tempfile.gettempdir()) / f"derail_ros_domain_{domain}"
    try:
        lock = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
    except OSError:
        return None  # another user's
    try:
        if fcntl is not None:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        if not in_use(domain):
            return lock
    except OSError:
        pass
    os.close(lock)
    return None


@contextlib.contextmanager
def free_domain(first: int) -> Iterator[int]:
    """A domain in which nobody is, from ``first`` on; held against others that ask here.

    Raises
    ------
    RuntimeError
        If all are taken.
    """
    for domain in (1 + (first + n) % DOMAINS for n in range(DOMAINS)):
        lock = _claim(domain)
        if lock is not None:
            try:
                yield domain
            finally:
                os.close(lock)
            return
    raise RuntimeError(f"no free ROS domain among 1 to {DOMAINS}")
