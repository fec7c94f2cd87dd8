"""The pacing of the cycle: wait for a time, or for a descriptor, whichever comes first."""

from __future__ import annotations

import ctypes
import os
import select
import struct
import time
from contextlib import suppress
from functools import partial
from typing import Any

from eap.compiled import cyclic

_CLOCK_MONOTONIC = 1
_TIMER_ABSTIME = 1
_TFD_CLOEXEC_NONBLOCK = os.O_CLOEXEC | os.O_NONBLOCK
_EVENTS = 8
_LONG_NS = 1_000_000
_LEAD_NS = 150_000
_LONGEST_POLL_NS = 50_000_000
_LARGEST_EVENT = 16
# struct epoll_event: its 64 bits of data, of which Python uses the first half for the descriptor,
# are packed behind the events on x86-64 only.
_EVENT = struct.Struct("=Ii4x" if os.uname().machine == "x86_64" else "=I4xi4x")

_library = ctypes.CDLL(None, use_errno=True)


class Ticker:
    """Waits on the monotonic clock, for the main thread of a process that runs cycles.

    Without descriptors it sleeps to an absolute time; with some it waits on them and a timerfd.
    Both were less late than a wait with a relative time-out, which the kernel rounds for
    processes that are not real-time.

    A long wait has two parts: the processor leaves its deep sleep and the caches warm up a little
    before the deadline instead of at its cost.  At 10 ms that halves the median lateness, and
    leaves a third of it where PM QoS is not to be had.

    A *spinning* ticker sleeps in the first tenth of a wait only, for a kernel stops a real-time
    process that never does.  Then it looks at the descriptors again and again, so that nothing has
    to wake the processor.

    Args:
        spins: Whether it is one.
    """

    def __init__(self, *, spins: bool = False) -> None:
        self._spins = spins
        self._waiter: Any = None
        """Compiled wait on the descriptors."""
        self._deadline = bytearray(32)
        address = ctypes.addressof(ctypes.c_char.from_buffer(self._deadline))
        self._times = memoryview(self._deadline).cast("q")
        self._sleep = partial(
            _library["clock_nanosleep"],
            _CLOCK_MONOTONIC,
            _TIMER_ABSTIME,
            ctypes.c_void_p(address + 16),
            None,
        )
        self._epoll: select.epoll | None = None
        self._timer = -1
        self._registered: set[int] = set()
        self._events = bytearray(_EVENTS * _LARGEST_EVENT)
        self._count = 0

    def register(self, fd: int) -> None:
        """Let *fd* end a wait when it becomes readable; it does so until it is read empty."""
        if self._epoll is None:
            self._open()
        assert self._epoll is not None  # noqa: S101  just opened
        self._epoll.register(fd, select.EPOLLIN)
        self._registered.add(fd)

    def unregister(self, fd: int) -> None:
        """Forget *fd*."""
        if self._epoll is not None and fd in self._registered:
            self._registered.remove(fd)
            with suppress(OSError):  # its owner has closed it already
                self._epoll.unregister(fd)

    def wait(self, deadline_ns: int) -> int:
        """Return the time once *deadline_ns* has passed, 0 if something else came first.

        That is a descriptor or a signal; a Python signal handler has run by the time this returns.
        A deadline in the past returns at once.
        """
        if self._waiter is not None:
            now_ns: int = self._waiter.wait(deadline_ns, self._spins)
            return now_ns
        self._count = 0
        now_ns = time.monotonic_ns()
        rest_ns = deadline_ns - now_ns
        if rest_ns <= 0:
            return now_ns
        if self._spins and self._registered:
            now_ns = self._wait_until(now_ns + rest_ns // 10)
            return self._spin_until(deadline_ns, now_ns) if now_ns else 0
        if rest_ns > _LONG_NS and not self._wait_until(deadline_ns - _LEAD_NS):
            return 0
        return self._wait_until(deadline_ns)

    def arrivals(self) -> list[int]:
        """Return the descriptors that the last wait found readable, at most eight of them."""
        count = self._count if self._waiter is None else self._waiter.count
        events = (_EVENT.unpack_from(self._events, n * _EVENT.size) for n in range(count))
        # Without the timer: it only ends the wait.
        return [fd for _, fd in events if fd in self._registered]

    def close(self) -> None:
        """Give the timer back."""
        if self._epoll is not None:
            self._epoll.close()
            os.close(self._timer)
            self._epoll = self._waiter = None
            self._registered.clear()

    def _wait_until(self, at_ns: int) -> int:
        self._times[2], self._times[3] = divmod(at_ns, 1_000_000_000)
        if not self._registered:
            return 0 if self._sleep() else time.monotonic_ns()
        self._set_timer()
        self._count = self._poll(-1)
        now_ns = time.monotonic_ns()
        return now_ns if now_ns >= at_ns else 0

    def _spin_until(self, at_ns: int, now_ns: int) -> int:
        until_ns = min(at_ns, now_ns + _LONGEST_POLL_NS)  # signals are handled behind it
        self._times[2] = self._times[3] = self._count = 0
        self._set_timer()  # it has expired, and would be found again and again
        while now_ns < until_ns and not self._count:
            self._count = self._poll(0)
            now_ns = time.monotonic_ns()
        return now_ns if now_ns >= at_ns else 0

    def _open(self) -> None:
        self._timer = _library["timerfd_create"](_CLOCK_MONOTONIC, _TFD_CLOEXEC_NONBLOCK)
        if self._timer < 0:
            number = ctypes.get_errno()
            raise OSError(number, os.strerror(number))
        self._epoll = select.epoll()
        self._epoll.register(self._timer, select.EPOLLIN)
        address = ctypes.addressof(ctypes.c_char.from_buffer(self._deadline))
        self._set_timer = partial(
            _library["timerfd_settime"], self._timer, _TIMER_ABSTIME, ctypes.c_void_p(address), None
        )
        events = ctypes.c_void_p(ctypes.addressof(ctypes.c_char.from_buffer(self._events)))
        self._poll = partial(_library["epoll_wait"], self._epoll.fileno(), events, _EVENTS)
        if cyclic is not None:
            self._waiter = cyclic.Waiter(
                self._epoll.fileno(), self._timer, self._events, _LONG_NS, _LEAD_NS
            )
