"""ROS domains that no other test, test run or stack on this machine uses."""

import functools
import os
import socket
from collections import deque

# From 102 on, the middleware's ports are among those that Linux gives to any program.
_DOMAINS = range(1, 102)
_KEPT = 12
"""More than a test needs at once: an older one is left to others, so that a long test run does not take them all."""

_PARTICIPANTS = 20
"""More than a stack has."""

_own_mark: socket.socket | None = None
_claims: deque[tuple[int, socket.socket]] = deque()


@functools.cache
def own_domain() -> int:
    """The domain of this process, until it ends."""
    global _own_mark
    domain, _own_mark = _claim()
    return domain


def fresh_domain() -> int:
    """A domain on which nothing runs; this process may have it until it has taken some more."""
    if len(_claims) == _KEPT:
        _, oldest = _claims.popleft()
        oldest.close()
    _claims.append(_claim())
    return _claims[-1][0]


def _claim() -> tuple[int, socket.socket]:
    # Onwards from the last one: what was left on it has time to go.
    first = (_claims[-1][0] if _claims else os.getpid()) % len(_DOMAINS)
    for domain in (*_DOMAINS[first:], *_DOMAINS[:first]):
        if _is_in_use(domain):
            continue
        # The kernel lets only one process have the name, and frees it when that process ends, however it ends.
        mark = socket.socket(socket.AF_UNIX)
        try:
            mark.bind(f"\0contact_reach_ros test domain {domain}")
        except OSError:
            mark.close()
            continue
        return domain, mark
    raise RuntimeError(f"every ROS domain from {_DOMAINS[0]} to {_DOMAINS[-1]} is in use: end other tests and stacks")


def _is_in_use(domain: int) -> bool:
    """Whether a participant has its port: of a stack that is none of the tests', or of a node that outlived its own."""
    for participant in range(_PARTICIPANTS):
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            try:
                probe.bind(("", 7400 + 250 * domain + 10 + 2 * participant))
            except OSError:
                return True
    return False
