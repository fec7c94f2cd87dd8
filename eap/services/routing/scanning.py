"""Scan of the plant through one connection: stations that routes lead to, their ports and slaves.

Each station is read by ADS, also the local ones: its list of devices at AMS port 300, and the
slaves at each master.  A station that does not answer is listed as in the plant file, with the
reason.
"""

from __future__ import annotations

import asyncio
from collections.abc import Iterable, Sequence
from typing import NamedTuple

from devicebus.wire.alstatus import state_name
from eap.ads.io import IoDeviceType
from eap.ads.request import OperationOutcome, Read, ReadDeviceInfo
from eap.ams.directory import AmsAddress, Directory
from eap.ams.routes import Route
from eap.ams.spec import DirectoryPort, DirectoryStation
from eap.codec.ads import AdsError, IndexGroup
from eap.codec.ams import DEVICE_PORT, IO_PORT
from eap.control.routes import ScannedPort, SlaveEntry, StationEntry
from eap.ids import STATION_OCTETS, NetId
from eap.services.routing.station_router import StationRouter
from eap.services.routing.tracing import find_fault, run_operation

ANSWER_TIMEOUT_S = 3.0
"""Time limit for one answer."""
STATION_TIMEOUT_S = 20.0
"""Time limit for all answers of a station."""
_MAX_CONCURRENT = 8
"""Stations that are scanned at a time."""
_MAX_PORTS = 64
_MAX_SIZE = 4096
_NAME = 0x1008_0000
_INTERFACE = 0x8000_0003
_INTERFACE_STEP = 0x1_0000
_KINDS: dict[int, str] = {IoDeviceType.MASTER: "bus", IoDeviceType.EAP: "eap"}
_STATUS = 0x1F
"""Mask of the AL state with its error bit."""
_LIST_OFFSETS = {"ids": 1, "name": 1, "net_id": 5, "type": 7}
"""Index offsets in the list of devices."""


class _FailedError(Exception):
    """Request without a usable answer; the text is the reason."""


class ScanTarget(NamedTuple):
    """Station that a scan reads."""

    name: str
    net_id: NetId
    planned: DirectoryStation | None


def scan_targets(directory: Directory, routes: Iterable[Route]) -> list[ScanTarget]:
    """Return the stations of the plant, then those that only routes lead to."""
    found = {
        each.net_id: ScanTarget(each.name, each.net_id, each)
        for each in directory.stations.values()
    }
    for route in routes:
        is_known = route.net_id in found or directory.station_of(route.net_id)
        if route.octets >= STATION_OCTETS and not is_known:
            found[route.net_id] = ScanTarget(route.name, route.net_id, None)
    return [*found.values()]


async def scan(station: StationRouter, known: Sequence[ScanTarget]) -> list[StationEntry]:
    """Scan all stations; return an entry for each, in their order.

    Args:
        station: Router that sends the requests.
        known: Stations to scan.
    """
    # Bounded: the requests of all stations may share their first hop, and its limits.
    slots = asyncio.Semaphore(_MAX_CONCURRENT)

    async def scan_one(each: ScanTarget) -> StationEntry:
        async with slots:
            return await _StationScan(station, each).station()

    async with asyncio.TaskGroup() as group:
        tasks = [group.create_task(scan_one(each)) for each in known]
    return [task.result() for task in tasks]


class _StationScan:
    """Scan of one station."""

    def __init__(self, router: StationRouter, known: ScanTarget) -> None:
        self._router = router
        self._known = known
        ports = known.planned.ports if known.planned else ()
        self._planned = {port.net_id: port for port in ports}

    async def station(self) -> StationEntry:
        """Return the station with its ports and slaves."""
        name, net_id = self._known.name, str(self._known.net_id)
        try:
            async with asyncio.timeout(STATION_TIMEOUT_S):
                ids = await self._read_io(0, "ids")
                # The first number of the list is the count of the devices.
                numbers = _numbers(ids)[1 : _MAX_PORTS + 1]
                ports = [await self._port(place, number) for place, number in enumerate(numbers)]
        except (_FailedError, TimeoutError) as exc:
            reason = str(exc) or f"no complete answer within {STATION_TIMEOUT_S:g} s"
            reason = await find_fault(self._router, self._known.net_id, IO_PORT) or reason
            planned = [_planned_port(port) for port in self._planned.values()]
            return StationEntry(name, net_id, planned, reason)
        # A stable sort: EAP ports first, each kind in the order of the station.
        ports.sort(key=lambda port: port.kind != "eap")
        return StationEntry(name, net_id, ports, "")

    async def _port(self, place: int, number: int) -> ScannedPort:
        """Return a port; *place* is its position in the list."""
        data = await self._read_io(number, "net_id")
        type_number = int.from_bytes(await self._read_io(number, "type"), "little")
        kind = _KINDS.get(type_number, "other")
        net_id = NetId(data[:6].ljust(6, b"\0"))
        planned = self._planned.get(net_id)
        name = _text(await self._read_io(number, "name"))
        interface = str(planned.interface) if planned else await self._interface(place)
        slaves: list[SlaveEntry] = []
        error = ""
        if kind == "bus":
            try:
                slaves = await self._slaves(net_id, planned)
            except _FailedError as exc:
                slaves, error = _planned_slaves(planned), str(exc)
        return ScannedPort(name, kind, str(net_id), interface, slaves, error)

    async def _interface(self, place: int) -> str:
        """Return the interface of a port from the dictionary of the router."""
        offset = _INTERFACE + place * _INTERFACE_STEP
        address = AmsAddress(self._known.net_id, DEVICE_PORT)
        try:
            return _text(await self._read(address, IndexGroup.SDO, offset))
        except _FailedError:
            return ""

    async def _slaves(self, net_id: NetId, planned: DirectoryPort | None) -> list[SlaveEntry]:
        master = AmsAddress(net_id, DEVICE_PORT)
        addresses = _numbers(await self._read(master, IndexGroup.SLAVE_ADDRESSES, 0))
        states = await self._read(master, IndexGroup.SLAVE_STATES, 0)
        names = {number: name for name, number in planned.slaves.items()} if planned else {}
        return [
            SlaveEntry(
                address,
                # The name of the plant file goes first; it saves a request for each slave.
                names.get(address) or await self._slave_name(net_id, address),
                _state(states[2 * place : 2 * place + 1]),
            )
            for place, address in enumerate(addresses)
        ]

    async def _slave_name(self, net_id: NetId, address: int) -> str:
        slave = AmsAddress(net_id, address)
        info = await self._request(slave, ReadDeviceInfo())
        if not info.result:
            return _text(info.data[4:])
        try:
            return _text(await self._read(slave, IndexGroup.SDO, _NAME))
        except _FailedError:
            return ""

    async def _read_io(self, number: int, what: str) -> bytes:
        address = AmsAddress(self._known.net_id, IO_PORT)
        return await self._read(address, IndexGroup.IO_DEVICES + number, _LIST_OFFSETS[what])

    async def _read(self, address: AmsAddress, group: int, offset: int) -> bytes:
        found = await self._request(address, Read(group, offset, _MAX_SIZE))
        if found.result:
            raise _FailedError(f"{address}: {AdsError.words_of(found.result)}")
        return found.data

    async def _request(
        self, address: AmsAddress, operation: Read | ReadDeviceInfo
    ) -> OperationOutcome:
        return await run_operation(self._router, *address, operation, ANSWER_TIMEOUT_S)


def _planned_port(port: DirectoryPort) -> ScannedPort:
    kind = "bus" if port.is_bus else "eap"
    return ScannedPort(
        port.name, kind, str(port.net_id), str(port.interface), _planned_slaves(port), ""
    )


def _planned_slaves(port: DirectoryPort | None) -> list[SlaveEntry]:
    """Return the slaves of the plant file, in unknown states."""
    if port is None:
        return []
    return [SlaveEntry(number, name, None) for name, number in port.slaves.items()]


def _state(octet: bytes) -> str | None:
    number = octet[0] & _STATUS if octet else 0
    return state_name(number) if number else None


def _text(data: bytes) -> str:
    text = data.partition(b"\0")[0].decode("utf-8", "replace")
    return "".join(
        each if each.isprintable() else "?" for each in text
    )  # control characters would reach terminals


def _numbers(data: bytes) -> list[int]:
    return [int.from_bytes(data[at : at + 2], "little") for at in range(0, len(data) - 1, 2)]
