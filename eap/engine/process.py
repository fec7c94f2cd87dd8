"""The engine process: the cycles of all stations of an appliance, and nothing beside them.

The supervisor starts it with the descriptor of its handover.  It reports that it runs when its
stations have run a cycle.  From then on it does not log and waits for nobody.
Its cycles make nothing that the garbage collector would look for; what requests to buses leave
behind when they fail is collected between them.
"""

from __future__ import annotations

import gc
import signal
import socket
import sys
from collections.abc import Callable
from functools import partial
from time import monotonic_ns

from eap.engine.arrivals import Arrivals
from eap.engine.build import EnginePlant
from eap.errors import ConfigError, EapError, EnvironmentalError
from eap.net import realtime
from eap.net.ticker import Ticker
from eap.runtime.handover import EngineOptions, Handover
from eap.runtime.passing import take_connection
from eap.runtime.startup import Startup

LOOK_PERIOD_NS = 20_000_000
"""How often the engine looks beyond its cycles, and takes at most one connection from services."""

GARBAGE = 5000
"""Objects that may be made and not given back before the collector looks at them."""


class StopFlag:
    """Set by SIGTERM; looked at once a cycle."""

    def __init__(self) -> None:
        self.is_set = False
        signal.signal(signal.SIGTERM, self._set)

    def _set(self, number: int, frame: object) -> None:
        self.is_set = True


def run_cycles(
    plant: EnginePlant, link: socket.socket, stop: StopFlag, tell: Callable[[], None]
) -> None:
    """Run every cycle when it is due, until *stop* is set; *tell* once the stations run."""
    engine, rebuilds = plant.engine, plant.rebuilds
    look_ns = 0
    is_told = False
    ticker = Ticker()
    try:
        arrivals = Arrivals(ticker, plant.arrivals)
        while not stop.is_set:
            if not is_told and engine.is_under_way:
                is_told = True
                tell()
            if not arrivals.wait(engine.next_timeout()):
                continue
            now_ns = monotonic_ns()
            engine.handle_timeout(now_ns)
            if rebuilds.is_ready:
                rebuilds.swap(now_ns)
            if now_ns >= look_ns:
                look_ns = now_ns + LOOK_PERIOD_NS
                plant.publish_discards()
                plant.buses.publish()
                if gc.get_count()[0] > GARBAGE and not rebuilds.is_building:
                    gc.collect()
                if passed := take_connection(link):
                    plant.add_connection(*passed)
    finally:
        ticker.close()


def run_engine(handover: Handover, startup: Startup) -> None:
    """Build all stations, report that they run, and run them until SIGTERM."""
    stop = StopFlag()
    link = socket.socket(fileno=handover.link_fd)
    plant = EnginePlant(handover, step=startup.step)
    try:
        startup.step("locking memory, setting the scheduler")
        report = _prepare(handover.options)
        startup.step("starting the stations")
        plant.start(monotonic_ns())
        startup.step("running the first cycle")
        # A program that attaches behind the ready line finds values of a cycle, not an empty image.
        run_cycles(plant, link, stop, partial(startup.finish, {"realtime": report}))
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
    return {"scheduler": "other: not asked for"}


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
