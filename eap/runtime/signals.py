"""SIGINT and SIGTERM as something readable, so that one loop can wait for them and for the rest."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager

_NUMBERS = (signal.SIGINT, signal.SIGTERM)


@contextmanager
def catch_end_signals() -> Iterator[int]:
    """Give a descriptor that becomes readable when this process is asked to end.

    The handlers from before are back when the block ends.
    """
    read_end, write_end = os.pipe2(os.O_CLOEXEC | os.O_NONBLOCK)
    old_fd = signal.set_wakeup_fd(write_end)
    old = [signal.signal(number, lambda *_: None) for number in _NUMBERS]
    try:
        yield read_end
    finally:
        for number, handler in zip(_NUMBERS, old, strict=True):
            signal.signal(number, handler)
        signal.set_wakeup_fd(old_fd)
        os.close(read_end)
        os.close(write_end)
