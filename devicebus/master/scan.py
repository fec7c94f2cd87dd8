"""Scan of a bus: number, identity and topology of the slaves.

A frame leaves a slave through its open ports in the order 3, 1, 2 and enters at port 0, so the open
ports of all slaves in the order of the frame give the tree (ETG.1000.4, DL status).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from devicebus.errors import BusError
from devicebus.master.eeprom import read_image, read_words, take_over
from devicebus.master.procedure import Procedure, not_answered, together
from devicebus.wire import sii
from devicebus.wire.datagram import DatagramReply, DatagramRequest, aprd, apwr, brd, fprd
from devicebus.wire.register import AlStatus, DlStatus, Register
from devicebus.wire.sii import Sii, SiiFixed
from eap.codec.wire import WireStruct, u8, u16, u32
from eap.errors import EapError

_ORDER = (3, 1, 2)


class TopologyNode(NamedTuple):
    """Position of a slave in the topology."""

    ports: tuple[int, ...]
    """Open ports of the slave."""
    parent: int | None
    """Position of the slave that it is connected to; None for the master."""
    parent_port: int
    entry_port: int


NOWHERE = TopologyNode((), None, 0, 0)
"""Topology node of a slave that is not there."""


def open_ports(status: DlStatus) -> tuple[int, ...]:
    """Return the ports with communication and an open loop."""
    pairs = (
        (status.loop0, status.communication0),
        (status.loop1, status.communication1),
        (status.loop2, status.communication2),
        (status.loop3, status.communication3),
    )
    return tuple(port for port, (loop, alive) in enumerate(pairs) if alive and not loop)


def find_topology(statuses: Sequence[DlStatus]) -> tuple[TopologyNode, ...]:
    """Return the topology node of each slave, in the order of positions.

    Open ports without a slave are tolerated: a slave behind them may have been lost meanwhile.
    """
    nodes: list[TopologyNode] = []
    exits: list[tuple[int, list[int]]] = []  # slaves with open ports whose slave is not yet known
    for position, status in enumerate(statuses):
        ports = open_ports(status)
        while exits and not exits[-1][1]:
            exits.pop()
        parent, port = (exits[-1][0], exits[-1][1].pop(0)) if exits else (None, 0)
        # The last slave of a line has no link at port 0 if it is entered by another port.  The
        # first behind the cut of a ring has none either: its frame comes from the second line,
        # turns round at port 0, and goes on through the other ports.
        is_behind_cut = parent is None and len(statuses) > 1
        entry = 0 if 0 in ports or not ports or is_behind_cut else ports[0]
        nodes.append(TopologyNode(ports, parent, port, entry))
        exits.append((position, [each for each in _ORDER if each in ports and each != entry]))
    return tuple(nodes)


def find_ring_end(nodes: Sequence[TopologyNode]) -> tuple[int, int] | None:
    """Return position and port of the open end that a frame leaves last; None without one."""
    for position, node in reversed(list(enumerate(nodes))):
        taken = {each.parent_port for each in nodes if each.parent == position} | {node.entry_port}
        if free := [port for port in _ORDER if port in node.ports and port not in taken]:
            return position, free[-1]
    return None


FIRST_STATION = 1001
"""Station address of the first slave, as TwinCAT counts."""
MAX_SLAVES = 0xFFFF - FIRST_STATION
_IDENTITY_WORD = 8
# Datagrams in flight at once while slaves are read one by one.
_DATAGRAMS_PER_STEP = 60


class EscInfo(WireStruct, frozen=True):
    """ETG.1000.4: type and features of a controller, from 0x0000 on."""

    type: u8
    revision: u8
    build: u16
    fmmus: u8
    sync_managers: u8
    ram: u8
    """Process data memory in KiB."""
    port_descriptor: u8
    features: u16

    @property
    def has_clock(self) -> bool:
        """True if it supports distributed clocks."""
        return bool(self.features & 0x04)

    @property
    def knows_lrw(self) -> bool:
        """True if it supports LRW."""
        return not self.features & 0x0200


class Identity(WireStruct, frozen=True):
    """ETG.2010: identity of a slave, from word 8 of the EEPROM on."""

    vendor: u32
    product: u32
    revision: u32
    serial: u32 = 0

    def __str__(self) -> str:
        return (
            f"vendor 0x{self.vendor:08X}, product 0x{self.product:08X},"
            f" revision 0x{self.revision:08X}"
        )


class FoundSlave(NamedTuple):
    """Slave found by a scan."""

    position: int
    station: int
    alias: int
    esc: EscInfo
    al_status: AlStatus
    node: TopologyNode
    identity: Identity
    sii: Sii
    fault: str = ""
    """Error of an unreadable EEPROM; identity and *sii* are empty then."""

    @property
    def name(self) -> str:
        """Name in the EEPROM, or the station address."""
        return self.sii.name or f"slave {self.station}"


class _Registers(NamedTuple):
    esc: EscInfo
    alias: int
    dl_status: DlStatus
    al_status: AlStatus


def count_slaves() -> Procedure[int]:
    """Return the number of slaves that a frame passes."""
    (reply,), _ = yield [brd(Register.TYPE, 1)]
    return reply.wkc


def scan(first_station: int = FIRST_STATION) -> Procedure[tuple[FoundSlave, ...]]:
    """Assign station addresses by position, and read registers and EEPROM of each slave.

    States and configuration of the slaves stay unchanged.

    Raises:
        WorkingCounterError: a slave was lost meanwhile.
        FrameLostError: no frame comes back.
    """
    count = yield from count_slaves()
    if count > MAX_SLAVES:
        raise BusError(f"{count} slaves answered, a bus has at most {MAX_SLAVES}")
    stations = range(first_station, first_station + count)
    # Positions change when a slave is lost; from here on slaves are addressed by station.
    yield from assign_stations(list(enumerate(stations)))
    registers = yield from _read_registers(stations)
    nodes = find_topology([each.dl_status for each in registers])
    images = yield from together([read_image(station) for station in stations])
    return tuple(
        _found(position, stations[position], registers[position], nodes[position], image)
        for position, image in enumerate(images)
    )


def find_slave(station: int) -> Procedure[FoundSlave]:
    """Read registers and EEPROM of one slave; position and topology node are those of none.

    Raises WorkingCounterError if it does not answer.
    """
    (registers,) = yield from _read_registers([station])
    (image,) = yield from together([read_image(station)])
    return _found(-1, station, registers, NOWHERE, image)


def read_topology(count: int) -> Procedure[list[tuple[int, TopologyNode]]]:
    """Return station address and topology node at each of the first *count* positions."""
    stations = yield from read_stations(count)
    replies = yield from in_frames(
        [aprd(at, Register.DL_STATUS, DlStatus.SIZE) for at in range(count)]
    )
    nodes = find_topology([DlStatus.decode(reply.data) for reply in replies])
    return list(zip(stations, nodes, strict=True))


def assign_stations(places: Sequence[tuple[int, int]]) -> Procedure[None]:
    """Assign station addresses to the slaves at the given positions.

    Raises WorkingCounterError for a position without a slave.
    """
    replies = yield from in_frames(
        [apwr(at, Register.STATION_ADDRESS, to.to_bytes(2, "little")) for at, to in places]
    )
    for (position, _), reply in zip(places, replies, strict=True):
        if reply.wkc != 1:
            raise not_answered(f"station address for position {position}", reply)


def read_stations(count: int) -> Procedure[list[int]]:
    """Return the station addresses at the first *count* positions; 0 for none."""
    replies = yield from in_frames([aprd(at, Register.STATION_ADDRESS, 2) for at in range(count)])
    return [int.from_bytes(reply.data, "little") if reply.wkc else 0 for reply in replies]


def read_identity(station: int) -> Procedure[Identity]:
    """Read the identity of a slave from its EEPROM.

    Raises:
        SiiError: the EEPROM cannot be read.
        WorkingCounterError: the slave did not answer.
    """
    yield from take_over(station)
    octets = b""
    while len(octets) < Identity.SIZE:
        octets += yield from read_words(station, _IDENTITY_WORD + len(octets) // 2)
    return Identity.decode(octets)


def _read_registers(stations: Sequence[int]) -> Procedure[list[_Registers]]:
    replies = yield from in_frames(
        [
            datagram
            for station in stations
            for datagram in (
                fprd(station, Register.TYPE, EscInfo.SIZE),
                fprd(station, Register.STATION_ALIAS, 2),
                fprd(station, Register.DL_STATUS, DlStatus.SIZE),
                fprd(station, Register.AL_STATUS, AlStatus.SIZE),
            )
        ]
    )
    found = []
    for number, station in enumerate(stations):
        info, alias, dl_status, al_status = replies[4 * number : 4 * number + 4]
        for reply in (info, alias, dl_status, al_status):
            if reply.wkc != 1:
                raise not_answered(f"slave {station}: reading registers", reply)
        found.append(
            _Registers(
                EscInfo.decode(info.data),
                int.from_bytes(alias.data, "little"),
                DlStatus.decode(dl_status.data),
                AlStatus.decode(al_status.data),
            )
        )
    return found


def _found(
    position: int, station: int, registers: _Registers, node: TopologyNode, image: bytes | EapError
) -> FoundSlave:
    fault = ""
    content = Sii(fixed=SiiFixed())
    try:
        if isinstance(image, EapError):
            raise image
        content = sii.decode(image)
    except EapError as exc:
        # One unreadable EEPROM must not fail the scan of the others.
        fault = f"slave {station}: its EEPROM cannot be used: {exc}"
    fixed = content.fixed
    identity = Identity(fixed.vendor, fixed.product, fixed.revision, fixed.serial)
    esc, alias, _, al_status = registers
    return FoundSlave(position, station, alias, esc, al_status, node, identity, content, fault)


def in_frames(datagrams: Sequence[DatagramRequest]) -> Procedure[list[DatagramReply]]:
    """Send any number of datagrams, a few frames at a time; return their replies."""
    replies: list[DatagramReply] = []
    for start in range(0, len(datagrams), _DATAGRAMS_PER_STEP):
        answers, _ = yield datagrams[start : start + _DATAGRAMS_PER_STEP]
        replies += answers
    return replies
