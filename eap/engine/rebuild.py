"""A running station gets another specification: built in a thread, swapped between two cycles.

The thread exists only while something is built.  It stands behind the cycles: they get the
interpreter within SWITCH_S of asking for it, and its processor at once.  What it builds belongs to
nobody until the cycle's thread takes it, which then only copies numbers.
"""

from __future__ import annotations

import gc
import os
import sys
import threading
from collections import deque
from collections.abc import Callable
from pathlib import Path

from eap.engine.successor import EngineStation, Successor
from eap.errors import EapError, EngineRefusedError
from eap.net import realtime
from eap.pd import pieces
from eap.pd.device import DeviceState
from eap.pd.engine import Engine
from eap.pd.spec import StationSpec
from eap.pd.station import Station
from eap.runtime.station_request import Configure, SetState, StationRequest

SWITCH_S = 1e-4
"""How long a cycle waits for the interpreter, as often as it lets go of it in a system call.

It wakes as often as that to ask again.  Where it shares a processor with the thread that builds, as
with ``--cpu``, an interval as short as such a wake-up takes (5 us were tried) leaves that thread no
time to let go of the interpreter, and both hang.
"""
MOST_WAITING = 64
_LOOK_S = 0.01
_SWAP_NS = 1_000_000
"""A swap begins so long before a cycle, or right after it."""

Reply = Callable[[EapError | None], None]


class _Job:
    """One request that is being served.

    Attributes:
        successor: What was built, if anything.
        error: Why nothing was, or why it did not take over.
        is_built: Whether the thread has made one of them.
        is_stale: Whether it has to be built again.
    """

    def __init__(self, place: EngineStation, request: Configure, reply: Reply) -> None:
        self.place = place
        self.request = request
        self.reply = reply
        self.successor: Successor | None = None
        self.error: EapError | None = None
        self.is_built = False
        self.is_stale = False
        self._before: Station | None = None
        self._taken = threading.Lock()

    def work(self, tell: Callable[[], object]) -> None:
        """Build, and *tell*; clear up when the cycle's thread has done its part, and tell again."""
        self._taken = threading.Lock()
        self._taken.acquire()
        self._build()
        self.is_built = True
        tell()
        self._taken.acquire()
        self.successor = None
        if self._before is not None:
            self._before.release()
            self._before = None
        tell()

    def take(self, engine: Engine, now_ns: int) -> None:
        """Put the successor in its place, if there is one; note that it has to be built again."""
        self.is_built = False
        successor = self.successor
        if successor is not None:
            self.is_stale = not successor.is_current
            if self.is_stale:
                successor.discard()  # PDs that shared an account have parted meanwhile
            else:
                self._put(successor, engine, now_ns)
        self.place.settle_tcp()
        self._taken.release()

    def give_up(self) -> None:
        """Do not put anything anywhere."""
        if self.is_built and self.successor is not None:
            self.successor.discard()
        if self._taken.locked():
            self._taken.release()

    def _build(self) -> None:
        self.is_stale = False
        try:
            spec = _read(self.request)
            if spec != self.place.station.spec:
                self.successor = Successor(self.place, spec)
        except EngineRefusedError as exc:
            self.error = exc
        except Exception as exc:  # noqa: BLE001  the engine goes on, whatever it was given
            text = str(exc) if isinstance(exc, EapError) else f"{type(exc).__name__}: {exc}"
            self.error = EngineRefusedError(f"station {self.request.station}: {text}")

    def _put(self, successor: Successor, engine: Engine, now_ns: int) -> None:
        try:
            self._before = successor.take_over(engine, now_ns)
        except EapError as exc:
            successor.discard()
            self.error = exc


class Rebuilds:
    """Does what services asks for with the *stations* of *engine*, one change after the other."""

    def __init__(self, engine: Engine, stations: dict[str, EngineStation]) -> None:
        self._engine = engine
        self._stations = stations
        self._waiting: deque[_Job] = deque()
        self._job: _Job | None = None
        self._thread: threading.Thread | None = None
        self._done = os.eventfd(0, os.EFD_CLOEXEC | os.EFD_NONBLOCK)
        self.is_ready = False
        """Whether :meth:`swap` should be called after the next cycle."""

    @property
    def is_building(self) -> bool:
        """Whether the thread runs."""
        return self._thread is not None

    def fileno(self) -> int:
        """Return the descriptor that becomes readable when the thread has got somewhere."""
        return self._done

    def close(self) -> None:
        """Wait for the thread, and give up what it builds."""
        if self._job is not None and self._thread is not None:
            while not self._job.is_built and self._thread.is_alive():
                self._thread.join(_LOOK_S)
            self._job.give_up()
            self._thread.join()
        os.close(self._done)

    def serve(self, request: StationRequest, now_ns: int, reply: Reply) -> None:
        """Begin with *request*; *reply* is called when it is done, or could not be."""
        place = self._stations.get(request.station)
        if place is None:
            reply(EngineRefusedError(f"there is no station {request.station}"))
        elif isinstance(request, SetState):
            reply(_set_state(place.station, request.state, now_ns))
        elif len(self._waiting) >= MOST_WAITING:
            reply(EngineRefusedError(f"{MOST_WAITING} changes wait already"))
        else:
            self._waiting.append(_Job(place, request, reply))
            if self._thread is None:
                self._begin(self._waiting.popleft())

    def collect(self, now_ns: int) -> None:
        """The thread has got somewhere: swap now, or after the next cycle if that is near."""
        os.eventfd_read(self._done)
        job, thread = self._job, self._thread
        if job is None or thread is None:
            return
        if job.is_built:
            self.is_ready = True
            if self._engine.next_timeout() - now_ns > _SWAP_NS:
                self.swap(now_ns)
            return
        thread.join()
        self._thread = None
        sys.setswitchinterval(_USUAL_SWITCH_S)
        if job.is_stale:
            self._begin(job)
        elif self._waiting:
            self._begin(self._waiting.popleft())

    def swap(self, now_ns: int) -> None:
        """Put what was built in its place."""
        self.is_ready = False
        job = self._job
        assert job is not None  # noqa: S101  is_ready said so
        job.take(self._engine, now_ns)
        gc.freeze()
        if not job.is_stale:
            job.reply(job.error)

    def _begin(self, job: _Job) -> None:
        self._job = job
        gc.collect()  # what is left is frozen afterwards, and nothing of it may be garbage
        sys.setswitchinterval(SWITCH_S)
        self._thread = threading.Thread(target=self._work, args=(job,), name="build")
        self._thread.start()

    def _work(self, job: _Job) -> None:
        realtime.stand_behind()
        job.work(lambda: os.eventfd_write(self._done, 1))


_USUAL_SWITCH_S = sys.getswitchinterval()


def _read(request: Configure) -> StationSpec:
    try:
        return pieces.from_lines(Path(request.path).read_bytes(), StationSpec)
    except (OSError, ValueError, LookupError) as exc:
        raise EngineRefusedError(f"{request.path}: {exc}") from None


def _set_state(station: Station, state: int, now_ns: int) -> EapError | None:
    try:
        station.go(DeviceState(state), now_ns)
    except ValueError:
        return EngineRefusedError(f"there is no state {state}, expected 2, 4 or 8")
    except EapError as exc:
        return exc
    return None
