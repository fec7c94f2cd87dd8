"""``status --json`` of one appliance: its processes from /proc, its stations from their images."""

from __future__ import annotations

import asyncio
import os
import resource
from collections.abc import Awaitable, Callable, Iterable, Mapping, Sequence
from ipaddress import IPv4Address
from pathlib import Path
from time import CLOCK_BOOTTIME, clock_gettime_ns, monotonic_ns, time_ns
from typing import Any

from msgspec.structs import asdict

from eap.errors import EnvironmentalError
from eap.ids import InterfaceUri
from eap.net.interface import interface_of, is_there, link_is_up
from eap.net.limits import ListenerStats
from eap.pd.image import Image
from eap.pd.report import group_list, station_status
from eap.pd.spec import PortKind
from eap.pd.words import StationWord
from eap.runtime.bridges import BridgeStatus
from eap.runtime.bus_status import bus_document, bus_link
from eap.runtime.engine_messages import BusReport
from eap.runtime.folder import ApplianceInfo, ProcessInfo
from eap.runtime.handover import PortName
from eap.services.tasks import TaskSet

VERSION = 1
# The kernel counts in ticks of 10 ms.
MIN_SAMPLE_NS = 200_000_000
"""Two questions closer than this get the same figures."""

SNAPSHOT_PAUSES = 100
"""A tenth of a second: an engine without real-time priority is interrupted for that long."""

_TICK_NS = 1_000_000_000 // os.sysconf("SC_CLK_TCK")
_PAGE = os.sysconf("SC_PAGE_SIZE")


NOTHING_MEASURED: dict[str, Any] = {"cpu": None, "rss": None, "descriptors": None}


class ProcessMeter:
    """CPU share and memory of processes, by pid, between one question and the next."""

    def __init__(self) -> None:
        self._samples: dict[int, tuple[int, int, dict[str, Any]]] = {}

    def measure(self, pid: int, now_ns: int) -> dict[str, Any]:
        """Return CPU share, memory and file descriptors of a process.

        *cpu* is in percent of one core since the last question, or since the process started,
        *rss* in bytes, both None for a process that is gone; *descriptors* has those *used* and
        their *limit*, None where they may not be seen.  *now_ns* is on the clock of process start
        times (CLOCK_BOOTTIME).
        """
        at_ns, before_ns, known = self._samples.get(pid, (0, 0, NOTHING_MEASURED))
        # The kernel counts in ticks: a share over a few milliseconds would be 0 or 100 %.
        if at_ns and now_ns - at_ns < MIN_SAMPLE_NS:
            return known
        try:
            # The process name in brackets may itself contain spaces and brackets (proc(5)).
            fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
            resident = int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * _PAGE
        except (OSError, IndexError):
            self._samples.pop(pid, None)
            return NOTHING_MEASURED
        used_ns = (int(fields[11]) + int(fields[12])) * _TICK_NS
        started_ns = int(fields[19]) * _TICK_NS
        since_ns = now_ns - (at_ns or started_ns)
        share = round(100 * (used_ns - before_ns) / since_ns, 1) if since_ns > 0 else 0.0
        document = {"cpu": share, "rss": resident, "descriptors": _descriptors(pid)}
        self._samples[pid] = now_ns, used_ns, document
        return document


class SharedAnswer:
    """Answer that is made once for all clients that request it while another one is being made.

    It is made after they asked, so it is never older than a question; a crowd that asks for
    something costly does not multiply the cost.
    """

    def __init__(self, make: Callable[[], Awaitable[dict[str, Any]]]) -> None:
        self._make = make
        self._lock = asyncio.Lock()
        self._next: asyncio.Task[dict[str, Any]] | None = None
        self._tasks = TaskSet("status")

    async def get(self) -> dict[str, Any]:
        """Return the next answer; errors of making it are raised."""
        if self._next is None:
            self._next = self._tasks.start_awaited(self._run())
        return await asyncio.shield(self._next)

    async def _run(self) -> dict[str, Any]:
        async with self._lock:
            # From here on the answer is in the making: later requests get the next one.
            self._next = None
            return await self._make()


def _descriptors(pid: int) -> dict[str, int] | None:
    try:
        used = len(os.listdir(f"/proc/{pid}/fd"))  # noqa: PTH208  ten times as quick
        limit, _ = resource.prlimit(pid, resource.RLIMIT_NOFILE)
    except OSError:
        return None
    return {"used": used, "limit": limit}


async def take_snapshot(image: Image) -> Image:
    """Return a consistent copy of *image*; other clients are served while the engine is in a cycle.

    If the engine stays in the middle of one, the copy is what it left there.
    """
    for _ in range(SNAPSHOT_PAUSES):
        if copy := image.try_snapshot():
            return copy
        await asyncio.sleep(0.0005)
    return image.snapshot()


def appliance_status(
    info: ApplianceInfo,
    images: Sequence[Image],
    discarded: Sequence[Mapping[str, Mapping[str, int]]],
    meter: ProcessMeter,
    buses: Mapping[PortName, BusReport],
    listeners: Iterable[ListenerStats] = (),
    bridges: Mapping[str, BridgeStatus] = {},
) -> dict[str, Any]:
    """Return the whole answer.

    Args:
        info: Report of the supervisor.
        images: Snapshots of all stations.
        discarded: Frames and requests that each process dropped, by station.
        meter: Of the processes.
        buses: Report of the engine on its buses; empty if it does not answer.
        listeners: Figures of the listeners of services.
        bridges: Status of those bridges that have one, by the names of their processes.
    """
    now_ns = clock_gettime_ns(CLOCK_BOOTTIME)
    engine = _process(info.engine, meter, now_ns)
    engine["realtime"] = info.engine.report.get("realtime", {})
    engine["compiled"] = info.engine.report.get("compiled")
    engine["groups"] = group_list(images)
    if report := next(iter(buses.values()), None):
        engine["bus_requests"] = {"malformed": report.malformed, "dropped": report.dropped}
    processes = {
        "supervisor": {"pid": info.supervisor, **meter.measure(info.supervisor, now_ns)},
        "engine": engine,
        "services": _process(info.services, meter, now_ns),
    }
    for name, process in info.extras.items():
        processes[name] = _process(process, meter, now_ns) | process.report
        if process.fault:
            processes[name]["fault"] = process.fault
        if (bridge := bridges.get(name)) is not None:
            processes[name]["bridge"] = {k: v for k, v in asdict(bridge).items() if k != "pid"}
    if info.segments:
        processes["segments"] = {
            name: _process(process, meter, now_ns) for name, process in info.segments.items()
        }
    return {
        "version": VERSION,
        "plant": info.plant,
        "processes": processes,
        "listeners": [_listener(each) for each in listeners],
        "stations": [_station(image, discarded, buses) for image in images],
    }


def _listener(stats: ListenerStats) -> dict[str, Any]:
    document = stats._asdict()
    crowded_at_ns = document.pop("crowded_at_ns")
    ago_us = None if crowded_at_ns is None else (monotonic_ns() - crowded_at_ns) // 1000
    return document | {"crowded_ago_us": ago_us}


def _station(
    image: Image,
    discarded: Sequence[Mapping[str, Mapping[str, int]]],
    buses: Mapping[PortName, BusReport],
) -> dict[str, Any]:
    station = station_status(image, monotonic_ns(), time_ns())
    station["cycle_age_us"] = _cycle_age_us(image)
    for port in station["ports"]:
        if port["kind"] == PortKind.BUS:
            report = buses.get(PortName(station["name"], port["name"]))
            port.update(bus_document(report, time_ns() / 1e9), link=bus_link(report))
        else:
            port["link"] = link_state(port["interface"])
            if fault := interface_fault(port["interface"]):
                port["fault"] = fault
    counts = station["discarded"]
    for by_station in discarded:
        for reason, count in by_station.get(image.layout.station, {}).items():
            counts[reason] = counts.get(reason, 0) + count
    return station


def _cycle_age_us(image: Image) -> int | None:
    """Return how long ago the last cycle ran, None before the first: a hung engine shows here."""
    ran_at_ns = image.words[StationWord.CYCLE_AT_NS]
    return max(monotonic_ns() - ran_at_ns, 0) // 1000 if ran_at_ns else None


def link_state(interface: str) -> str:
    """Return ``up`` or ``down`` for the network interface behind a port's URI."""
    uri = InterfaceUri.parse(interface)
    if uri.scheme == "loop":
        return "up"
    try:
        name = uri.host if uri.scheme == "ethernet" else interface_of(uri.host)
    except EnvironmentalError:
        return "down"  # the address has been taken from this machine
    return "up" if link_is_up(name) else "down"


def interface_fault(interface: str) -> str:
    """Return what has become of the network interface behind a port's URI, empty if it is there."""
    uri = InterfaceUri.parse(interface)
    if uri.scheme == "ethernet":
        return "" if is_there(uri.host) else f"interface {uri.host} is gone: it was deleted"
    if uri.scheme == "loop" or IPv4Address(uri.host).is_unspecified:
        return ""
    try:
        interface_of(uri.host)
    except EnvironmentalError:
        return f"address {uri.host} is gone: no interface has it now"
    return ""


def _process(process: ProcessInfo, meter: ProcessMeter, now_ns: int) -> dict[str, Any]:
    measured = meter.measure(process.pid, now_ns) if process.pid else NOTHING_MEASURED
    document = {"pid": process.pid or None, **measured, "restarts": process.restarts}
    return document | {"step": process.step} if process.step else document
