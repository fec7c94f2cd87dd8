"""File descriptors of this process: its limit, and how many it may still open.

The kernel gives out the lowest free number, so a descriptor numbered n says that at least n others
are open: no bookkeeping is needed to know how near the limit is.
"""

from __future__ import annotations

import errno
import resource
from contextlib import suppress

_MOST_RESERVED = 128
_UNLIMITED = 1 << 20
OUT_OF_DESCRIPTORS = frozenset((errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM))
"""Errors of a call that found nothing left to open a socket with."""


def raise_descriptor_limit() -> int:
    """Raise the soft limit to the hard one, for this process and its children; return it."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    with suppress(OSError, ValueError):  # a sandbox may forbid it
        resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
        return hard
    return soft


def descriptor_reserve() -> int:
    """Return how many descriptors are kept for files, buses, routes and the control socket."""
    return min(_MOST_RESERVED, _limit() // 4)


def spare_descriptors(newest: int, reserve: int) -> int:
    """Return how many descriptors are left without *reserve*, after *newest* was opened."""
    return _limit() - reserve - 1 - newest


def _limit() -> int:
    limit = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
    return _UNLIMITED if limit == resource.RLIM_INFINITY else limit
