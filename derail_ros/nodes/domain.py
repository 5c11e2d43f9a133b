"""A ROS domain that no other graph uses."""

from __future__ import annotations

import contextlib
import socket
from collections.abc import Iterator

DOMAINS = 101
"""Domains 1 to 101 keep clear of the ports that the system gives to programs."""


PARTICIPANTS = 10
"""Numbers of participants that are looked for in a domain."""


def port(domain: int) -> int:
    """UDP port of the first participant in a domain (DDSI-RTPS 2.5, 9.6.2.3)."""
    return 7410 + 250 * domain


def in_use(domain: int) -> bool:
    """Whether a participant of this machine is in a domain.

    Each participant of a process has a number of its own, whatever its domain, and listens two
    ports further for each: all that a machine commonly has are looked at.
    """
    return any(_bound(port(domain) + 2 * number) for number in range(PARTICIPANTS))


def _bound(number: int) -> bool:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind(("", number))
        except OSError:
            return True
    return False


@contextlib.contextmanager
def free_domain(first: int) -> Iterator[int]:
    """A domain without a participant, from ``first`` on; no other caller gets it meanwhile.

    The claim is the TCP port of that number, which the system takes back however a process ends.

    Raises
    ------
    RuntimeError
        If all are taken.
    """
    for domain in (1 + (first + n) % DOMAINS for n in range(DOMAINS)):
        with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as claim:
            try:
                claim.bind(("127.0.0.1", port(domain)))
            except OSError:
                continue
            if not in_use(domain):
                yield domain
                return
    raise RuntimeError(f"no free ROS domain among 1 to {DOMAINS}")
