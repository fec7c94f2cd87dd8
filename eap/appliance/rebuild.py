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

import msgspec

from eap.appliance.station_request import Configure, SetState, StationRequest
from eap.appliance.successor import EngineStation, Successor
from eap.errors import EapError, EngineRefusedError
from eap.net import realtime
from eap.pd.device import DeviceState
from eap.pd.engine import Engine
from eap.pd.spec import StationSpec
from eap.pd.station import Station

SWITCH_S = 5e-6
"""How long a cycle waits for the interpreter, as often as it lets go of it in a system call."""
MOST_WAITING = 64
_SWAP_NS = 1_000_000
"""A swap begins so long before a cycle, or right after it."""

Reply = Callable[[EapError | None], None]


class _Job:
    """One request that is being served."""

    def __init__(self, place: EngineStation, request: Configure, reply: Reply) -> None:
        self.place = place
        self.request = request
        self.reply = reply
        self.successor: Successor | None = None
        self.error: EapError | None = None

    def build(self) -> None:
        """Make the successor, or the error."""
        try:
            spec = _read(self.request)
            if spec != self.place.station.spec:
                self.successor = Successor(self.place, spec)
        except EngineRefusedError as exc:
            self.error = exc
        except Exception as exc:  # noqa: BLE001  the engine goes on, whatever it was given
            text = str(exc) if isinstance(exc, EapError) else f"{type(exc).__name__}: {exc}"
            self.error = EngineRefusedError(f"station {self.request.station}: {text}")


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
        """Return the descriptor that becomes readable when something was built."""
        return self._done

    def close(self) -> None:
        """Wait for the thread, and give up what it builds."""
        if self._thread is not None:
            self._thread.join()
        if self._job is not None and self._job.successor is not None:
            self._job.successor.discard()
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
            if self._job is None:
                self._begin(self._waiting.popleft())

    def collect(self, now_ns: int) -> None:
        """The thread is done: swap now, or after the next cycle if that is near."""
        os.eventfd_read(self._done)
        self.is_ready = True
        if self._engine.next_timeout() - now_ns > _SWAP_NS:
            self.swap()

    def swap(self) -> None:
        """Finish what was built."""
        self.is_ready = False
        job, thread = self._job, self._thread
        assert job is not None and thread is not None  # noqa: S101, PT018  is_ready said so
        thread.join()
        self._thread = None
        if job.successor is not None and not job.successor.is_current:
            job.successor.discard()  # PDs that shared an account have parted meanwhile
            self._begin(job)
            return
        if job.successor is not None:
            try:
                job.successor.take_over(self._engine)
            except EapError as exc:
                job.successor.discard()
                job.error = exc
        gc.freeze()
        sys.setswitchinterval(_SWITCH_S)
        self._job = None
        job.reply(job.error)
        if self._waiting:
            self._begin(self._waiting.popleft())

    def _begin(self, job: _Job) -> None:
        job.successor = None
        self._job = job
        gc.collect()  # what is left is frozen afterwards, and nothing of it can be garbage
        sys.setswitchinterval(SWITCH_S)
        self._thread = threading.Thread(target=self._build, args=(job,), name="build")
        self._thread.start()

    def _build(self, job: _Job) -> None:
        realtime.stand_behind()
        job.build()
        os.eventfd_write(self._done, 1)


_SWITCH_S = sys.getswitchinterval()


def _read(request: Configure) -> StationSpec:
    try:
        return msgspec.json.decode(Path(request.path).read_bytes(), type=StationSpec)
    except (OSError, msgspec.MsgspecError) as exc:
        raise EngineRefusedError(f"{request.path}: {exc}") from None


def _set_state(station: Station, state: int, now_ns: int) -> EapError | None:
    try:
        station.go(DeviceState(state), now_ns)
    except ValueError:
        return EngineRefusedError(f"there is no state {state}, expected 2, 4 or 8")
    except EapError as exc:
        return exc
    return None
