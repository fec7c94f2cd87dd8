"""The engine process: runs the cycles of all stations of an appliance.

The supervisor starts it with the descriptor of its handover.  It reports that it runs when its
stations have run a cycle.  From then on it does not log, and waits for no other process.
Its cycles allocate nothing that the garbage collector would look for.  What failed requests to
buses leave behind is collected between cycles.
"""

from __future__ import annotations

import gc
import signal
import socket
import sys
from collections.abc import Callable, Collection, Mapping
from functools import partial
from time import monotonic_ns

from eap.compiled import cyclic
from eap.engine.build import EnginePlant
from eap.errors import ConfigError, EapError, EnvironmentalError
from eap.net import realtime
from eap.net.ticker import Ticker
from eap.runtime.handover import EngineOptions, Handover
from eap.runtime.passing import receive_passed
from eap.runtime.startup import Startup

WINDOW_NS = 20_000_000
SHARE_NS = 12_000_000
"""Of each window; then descriptors wait for the next one, while cycles still drain channels."""


class CycleWaiter:
    """Waits for the next cycle and serves *handlers* meanwhile, for a bounded share of the time.

    Without the bound a sender without pause would starve the cycles.  A kernel that limits
    real-time processes also stops a process that never sleeps.  The owner closes *ticker*.
    """

    def __init__(self, ticker: Ticker, handlers: Mapping[int, Callable[[int], object]]) -> None:
        self._ticker = ticker
        self._handlers = handlers
        self._registered: dict[int, Callable[[int], object]] = {}
        self._spent_ns = 0
        self._window_end_ns = 0
        self._is_open = False
        self._open()

    def wait(self, deadline_ns: int) -> int:
        """Return the time once *deadline_ns* has passed, 0 if descriptors were served first."""
        if self._is_open:
            now_ns = self._ticker.wait(deadline_ns)
            if not now_ns:
                self._serve()
            return now_ns
        # The descriptors are unregistered, not ignored: a readable one would end every wait at
        # once.
        now_ns = self._ticker.wait(min(deadline_ns, self._window_end_ns))
        if monotonic_ns() >= self._window_end_ns:
            self._open()
        return now_ns if now_ns >= deadline_ns else 0

    def _serve(self) -> None:
        begun_ns = monotonic_ns()
        if begun_ns >= self._window_end_ns:
            self._window_end_ns = begun_ns + WINDOW_NS
            self._spent_ns = 0
        for fd in self._ticker.arrivals():
            # A handler may close the descriptors of others.
            if (handler := self._handlers.get(fd)) is not None:
                handler(monotonic_ns())
        self._spent_ns += monotonic_ns() - begun_ns
        if self._spent_ns > SHARE_NS:
            self._close()

    def update(self) -> None:
        """Follow the descriptors that were added to the handlers, or removed and closed."""
        if self._is_open:
            self._unregister({fd for fd in self._registered if self._is_other(fd)})
            self._register()

    def _is_other(self, fd: int) -> bool:
        # Compared by handler: the number of a closed descriptor may be that of another socket now.
        return self._handlers.get(fd) != self._registered[fd]

    def _register(self) -> None:
        for fd, handler in self._handlers.items():
            if fd not in self._registered:
                self._registered[fd] = handler
                self._ticker.register(fd)

    def _unregister(self, descriptors: Collection[int]) -> None:
        for fd in descriptors:
            del self._registered[fd]
            self._ticker.unregister(fd)

    def _open(self) -> None:
        self._is_open = True
        self._register()

    def _close(self) -> None:
        self._is_open = False
        self._unregister([*self._registered])


LOOK_PERIOD_NS = 20_000_000
"""Interval of work beside the cycles; each time at most one descriptor of services is taken."""

GARBAGE = 5000
"""Objects allocated and not freed before the garbage collector runs."""


class StopFlag:
    """Set by SIGTERM; read once a cycle."""

    def __init__(self) -> None:
        self.is_set = False
        signal.signal(signal.SIGTERM, self._set)

    def _set(self, number: int, frame: object) -> None:
        self.is_set = True


def run_cycles(
    plant: EnginePlant,
    link: socket.socket,
    stop: StopFlag,
    notify: Callable[[], None],
    *,
    spins: bool = False,
) -> None:
    """Run every cycle when it is due, until *stop* is set; *notify* once the stations run."""
    engine, rebuilder = plant.engine, plant.rebuilder
    look_ns = 0
    is_notified = False
    ticker = Ticker(spins=spins)
    try:
        arrivals = CycleWaiter(ticker, plant.arrivals)
        rebuilder.on_swap.append(arrivals.update)
        plant.buses.on_change.append(arrivals.update)
        rebuilder.receive_sockets = partial(_take_all, plant, link)
        while not stop.is_set:
            if not is_notified and engine.is_under_way:
                is_notified = True
                notify()
            now_ns = arrivals.wait(engine.next_timeout())
            if not now_ns:
                continue
            engine.handle_timeout(now_ns)
            while engine.is_within_group:
                engine.handle_timeout(monotonic_ns())
            if rebuilder.is_ready:
                rebuilder.swap(now_ns)
            if now_ns >= look_ns:
                look_ns = now_ns + LOOK_PERIOD_NS
                plant.publish_discards()
                plant.look_at_keys()
                plant.buses.publish()
                plant.recording.look(now_ns)
                # Automatic collection is off; this is between two cycles.
                if gc.get_count()[0] > GARBAGE and not rebuilder.is_building:
                    gc.collect()
                if passed := receive_passed(link):
                    plant.take(*passed)
    finally:
        ticker.close()


def _take_all(plant: EnginePlant, link: socket.socket) -> None:
    """Take everything that services has passed."""
    while passed := receive_passed(link):
        plant.take(*passed)


def run_engine(handover: Handover, startup: Startup) -> None:
    """Build all stations, report that they run, and run them until SIGTERM."""
    stop = StopFlag()
    link = socket.socket(fileno=handover.link_fd)
    plant = EnginePlant(handover, step=startup.step)
    try:
        startup.step("locking memory, setting the scheduler")
        report = _prepare(handover.options)
        if handover.options.spins:
            report["spins"] = True
        startup.step("starting the stations")
        plant.start(monotonic_ns())
        startup.step("running the first cycle")
        started = {"realtime": report, "compiled": cyclic is not None}
        # A program that attaches behind the ready line finds values of a cycle, not an empty image.
        notify = partial(startup.finish, started)
        run_cycles(plant, link, stop, notify, spins=handover.options.spins)
        plant.stop()
    finally:
        plant.close()
        link.close()


def _prepare(options: EngineOptions) -> realtime.Report:
    if options.realtime:
        cpus = [options.cpu] if options.cpu >= 0 else []
        return realtime.prepare(options.priority, cpus)
    gc.collect()
    gc.freeze()
    gc.disable()
    return {"scheduler": "other: not requested"}


def main(handover_fd: int, startup: Startup) -> int:
    """Return the exit code: 2 for what this machine or the specification lacks."""
    handover = Handover.from_descriptor(handover_fd)
    realtime.die_with_parent(handover.supervisor)
    try:
        run_engine(handover, startup)
    except EapError as exc:
        sys.stderr.write(f"engine: {exc}\n")
        return 2 if isinstance(exc, (ConfigError, EnvironmentalError)) else 1
    return 0
