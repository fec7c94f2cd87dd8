"""The product as the master of a simulated segment, through the session that ``eapctl bus`` has."""

from __future__ import annotations

import select
from contextlib import closing
from io import BytesIO
from pathlib import Path
from time import monotonic_ns, perf_counter_ns
from typing import Any

from devicebus.mailbox import foe_client
from devicebus.mailbox.coe_client import upload
from devicebus.mailbox.conversation import Conversation
from devicebus.mailbox.protocol import MailboxSizes
from devicebus.wire.alstatus import AlState
from eap.engine.bus_settings import master_settings
from eap.engine.engine_bus import EngineBus
from eap.ids import InterfaceUri
from eap.net.busport import open_bus_port
from eap.net.image_file import create_image
from eap.ops.bus_session import open_bus
from eap.pd.layout import plan_layout
from eap.pd.station import Station
from eap.runtime.plantfile import load_plant
from tools.bench.buses import FILE
from tools.bench.network import Page
from tools.bench.pacing import answer, run_phases

_LONGEST_NS, _SPIN_NS = 20_000_000, 300_000
"""Wait for a frame, and the part of it that polls: longer than a round trip."""
_UP_WITHIN_NS = 20_000_000_000
_SETTLED = 100
"""Good cycles after which all slaves are in OP."""


def cycles(job: dict[str, Any]) -> None:
    """Bring all slaves to OP; then run the cycles of a station, the next when a frame is back."""
    words = Page(Path(job["page"])).words
    plant = load_plant(Path(job["plant"])).plant
    assert plant is not None  # noqa: S101  the benchmark has written it
    (spec,) = plant.stations
    (port,) = spec.ports
    with (
        create_image(Path(job["folder"]) / "bus.image", plan_layout(spec)) as file,
        closing(open_bus_port(port.interface)) as line,
    ):
        station = Station(spec, file.image, file.wake_waiters)
        settings = master_settings(port, spec.cycle_us, 0)
        bus = EngineBus(port, settings, station.cycle_ns, file.image, station.memory_of, line)
        station.connect_bus(bus)
        station.start(monotonic_ns())
        bus.start(monotonic_ns())

        def exchange() -> None:
            begin_ns = now_ns = monotonic_ns()
            station.cycle(now_ns, now_ns)
            while bus.master.is_waiting and now_ns < begin_ns + _LONGEST_NS:
                if now_ns > begin_ns + _SPIN_NS:  # a busy machine wakes sooner who has slept
                    select.select([line], [], [], _LONGEST_NS / 1e9)
                now_ns = monotonic_ns()
                bus.receive(now_ns)

        def good() -> int:
            cycle = bus.master.stats().cycle
            return 0 if cycle is None else cycle.good

        end_ns = monotonic_ns() + _UP_WITHIN_NS
        while not bus.is_up or good() < _SETTLED:
            exchange()
            if monotonic_ns() > end_ns:
                raise RuntimeError(f"the bus does not come up: {bus.fault}")
        slaves = len(bus.master.slaves)
        answer({"slaves": slaves, "rates": run_phases(words, job, exchange, good)})


def acyclic(job: dict[str, Any]) -> None:
    """Scan, read an object, write a file; answer with the nanoseconds of each."""
    scans, reads, files = [], [], []
    with open_bus(InterfaceUri.parse(f"ethernet://{job['interface']}")) as session:
        for _ in range(job["scans"]):
            begin = perf_counter_ns()
            units = session.scan()
            scans.append(perf_counter_ns() - begin)
        session.bring(units, AlState.PREOP)
        first = units[0]
        for _ in range(job["reads"]):
            begin = perf_counter_ns()
            session.converse(first, lambda sizes: upload(0x1018, 1), "reading an object")
            reads.append(perf_counter_ns() - begin)
        content = bytes(job["size"])

        def write(sizes: MailboxSizes) -> Conversation[int]:
            return foe_client.write(FILE, BytesIO(content).read, sizes)

        for _ in range(job["files"]):
            begin = perf_counter_ns()
            session.converse(first, write, "writing a file")
            files.append(perf_counter_ns() - begin)
        session.bring(units, AlState.INIT)
    answer({"slaves": len(units), "scan": scans, "read": reads, "file": files})
