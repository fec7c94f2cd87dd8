"""Scheduling and limits of this process, and a report of what the kernel granted.

A plant runs without any of it: what is not permitted is left out and reported.
"""

from __future__ import annotations

import ctypes
import errno
import gc
import os
import resource
import signal
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import TypeAlias

from eap.errors import EnvironmentalError

Report: TypeAlias = dict[str, str | bool | int | list[int]]

_PR_SET_PDEATHSIG = 1
_PR_SET_TIMERSLACK = 29
_PR_GET_TIMERSLACK = 30
_MCL_CURRENT, _MCL_FUTURE, _MCL_ONFAULT = 1, 2, 4
_CAP_IPC_LOCK = 14
_DMA_LATENCY = "/dev/cpu_dma_latency"

_library = ctypes.CDLL(None, use_errno=True)


def prepare(priority: int, cpus: Iterable[int] = ()) -> Report:
    """Ask for SCHED_FIFO at *priority* on *cpus* (none: all), and for what else helps.

    That is locked memory, no power saving of the processors (held until the process ends), exact
    timers and no garbage collection: call this when everything has been built.  A *priority* of
    0 leaves the scheduler as it is.

    Returns:
        What the kernel granted, or in its place the reason that it did not.
    """
    report: Report = {
        "scheduler": _set_scheduler(priority),
        "cpus": _set_affinity(list(cpus)),
        "memory_locked": _lock_memory(),
        "pm_qos": _hold_latency(),
        "timer_slack_ns": _set_timer_slack(),
    }
    # The cycles make no reference cycles: an automatic collection would only delay them.
    gc.collect()
    gc.freeze()
    gc.disable()
    return report


def require_cores() -> None:
    """Raise EnvironmentalError unless one process may take a processor for itself."""
    if len(os.sched_getaffinity(0)) < 2:
        raise EnvironmentalError(
            "realtime.spin cannot be used: the engine would take the only processor that this"
            " appliance has; remove the key, or allow it a second one"
        )


def raise_process_priority(nice: int = -10) -> None:
    """Set the priority of this process to *nice* (-20 to 19), its share of a busy machine.

    -10 is ten times the share of an ordinary process.  Less than 0 takes CAP_SYS_NICE; without it
    the process keeps the share that it has.
    """
    with suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, 0, nice)


def die_with_parent(parent_pid: int, number: signal.Signals = signal.SIGKILL) -> None:
    """Have the kernel send *number* to this process when its parent *parent_pid* ends.

    *parent_pid* is the pid that the parent gave: if the parent has already ended, this process has
    another parent now, and the signal is sent at once.
    """
    _library["prctl"](_PR_SET_PDEATHSIG, int(number), 0, 0, 0)
    # A parent that ended before prctl causes no signal.
    if os.getppid() != parent_pid:
        os.kill(os.getpid(), number)


def lower_thread_priority() -> None:
    """Lower the priority of the calling thread below that of the other threads of its process.

    With SCHED_FIFO it goes one step down, for a thread of the same priority would not be
    interrupted; other processes stay behind it, so that it does not sleep with what others need.
    """
    if os.sched_getscheduler(0) == os.SCHED_FIFO:
        priority = os.sched_getparam(0).sched_priority
        if priority > 1:
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority - 1))


def _set_scheduler(priority: int) -> str:
    if priority:
        try:
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
        except PermissionError:
            return "other: needs CAP_SYS_NICE or a limit for rtprio (ulimit -r)"
        except OSError as error:
            return f"other: {error.strerror} (priority {priority})"
        return f"fifo {priority}"
    return "other: not requested"


def _set_affinity(cpus: list[int]) -> list[int] | str:
    if cpus:
        try:
            os.sched_setaffinity(0, cpus)
        except OSError as error:
            return f"{error.strerror}: {cpus}"
    return sorted(os.sched_getaffinity(0))


def _lock_memory() -> bool | str:
    limit = resource.getrlimit(resource.RLIMIT_MEMLOCK)[0]
    if limit != resource.RLIM_INFINITY and not _has_capability(_CAP_IPC_LOCK):
        # Within a limit the lock would succeed and a later allocation fail.
        return f"needs CAP_IPC_LOCK or no limit for memlock (ulimit -l is {limit // 1024} kB)"
    # ONFAULT: a thread's stack of several MB would else be in memory as a whole.
    if _library["mlockall"](_MCL_CURRENT) or _library["mlockall"](_MCL_FUTURE | _MCL_ONFAULT):
        return os.strerror(ctypes.get_errno())
    return True


def _has_capability(number: int) -> bool:
    status = Path("/proc/self/status").read_text()
    effective = status.partition("CapEff:")[2].split(maxsplit=1)[0]
    return bool(int(effective, 16) >> number & 1)


def _hold_latency() -> bool | str:
    try:
        fd = os.open(_DMA_LATENCY, os.O_WRONLY | os.O_CLOEXEC)
    except OSError as error:
        return f"{_DMA_LATENCY}: {error.strerror}"
    try:
        # A latency of 0 us, as a binary number of 32 bits.
        os.write(fd, bytes(4))
    except OSError as error:
        os.close(fd)
        return f"{_DMA_LATENCY}: {error.strerror}"
    return True  # the request lasts until the descriptor is closed at the end of the process


def _set_timer_slack() -> int:
    # 1 ns: 0 would mean the default of 50 us.
    _library["prctl"](_PR_SET_TIMERSLACK, 1, 0, 0, 0)
    return int(_library["prctl"](_PR_GET_TIMERSLACK, 0, 0, 0, 0))


# The kernel gives out the lowest free number: a descriptor numbered n shows that at least n others
# are open, so that no bookkeeping is needed to know how near the limit is.
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
    # A quarter, where a limit is so low that the whole reserve would leave no place for
    # connections.
    return min(_MOST_RESERVED, _limit() // 4)


def spare_descriptors(newest: int, reserve: int) -> int:
    """Return how many descriptors are left without *reserve*, after *newest* was opened."""
    return _limit() - reserve - 1 - newest


def _limit() -> int:
    limit = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
    return _UNLIMITED if limit == resource.RLIM_INFINITY else limit
