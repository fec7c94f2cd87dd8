"""Order in which processes see shared memory: data, and the words that say whether it is whole.

A writer stores a word, then data, then the word again; a reader loads them in the opposite order.
x86-64 shows other processors all stores in their order and makes all loads in theirs.  Others, such
as ARM64, do neither unless they are told: :func:`keep_order` goes between a word and its data, on
both sides.  The compiled part orders its own stores and loads.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from threading import Lock

from eap.compiled import cyclic

REORDERS = os.uname().machine not in {"x86_64", "i686", "i586", "i386"}
"""True on processors that need :func:`keep_order`; checked where a call would cost too much."""


def order_by_lock() -> None:
    """Keep the order without the compiled part: release a lock, then acquire it again.

    Nothing moves from before the release to behind it, or from behind the acquisition to before
    it; and processors do not exchange a release and a later acquisition (ARM64: a load-acquire is
    never made before an earlier store-release).  So this is a full barrier.
    """
    lock = Lock()  # its own: threads may call this at the same time
    lock.acquire()
    lock.release()
    lock.acquire()


def _order_of_itself() -> None:
    """Do nothing: the processor keeps the order."""


def _choose(*, reorders: bool) -> Callable[[], None]:
    if not reorders:
        return _order_of_itself
    compiled: Callable[[], None] | None = getattr(cyclic, "keep_order", None)
    return compiled or order_by_lock


keep_order = _choose(reorders=REORDERS)
"""Have all loads and stores before the call be made before all behind it."""
