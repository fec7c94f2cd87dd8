"""I/O server behind port 300 and the EtherCAT masters that it lists, as TwinCAT shows them.

The groups are those that Beckhoff's adstool reads (ECatAccess.cpp of AdsLib), the numbers of types
those of TwinCAT's TCatSysManagerLib.  Beckhoff documents the groups of a master: states are AL
states (ETG.1000.6); in the state of a slave 0x10 is an error, 0x20 a wrong identity, 0x40 an init
command that failed, and beside it is the state of its links.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Sequence
from enum import IntEnum
from typing import NamedTuple, Protocol

from eap.ads.request import AdsRefusedError
from eap.ads.space import BOOT, INIT, OP, PREOP, SAFEOP, AdsSpace, Source, fixed_size_source
from eap.codec.ads import AdsError, IndexGroup
from eap.codec.adssymbol import encode_text
from eap.ids import NetId

_MAX_ID = 0xFFF


class _Offset(IntEnum):
    IDS_OR_NAME = 1
    COUNT = 2
    NET_ID = 5
    TYPE = 7


class IoDeviceType(IntEnum):
    """IODEVICETYPE."""

    MASTER = 111
    """IODEVICETYPE_ETHERCATPROT"""
    EAP = 112
    """IODEVICETYPE_ETHERNETNVPROT"""


class IoDevice(NamedTuple):
    """One port of the station; *id* is from 1 to 4095."""

    id: int
    name: str
    type: IoDeviceType
    net_id: NetId


class IoSpace(AdsSpace):
    """The list of devices; *devices* are listed in their order."""

    groups: Collection[int] = range(IndexGroup.IO_DEVICES, IndexGroup.IO_DEVICES + _MAX_ID + 1)

    def __init__(self, devices: Iterable[IoDevice]) -> None:
        self.follow(devices)

    def follow(self, devices: Iterable[IoDevice]) -> None:
        """List other *devices* from now on."""
        self._devices = {device.id: device for device in devices}

    def read(self, group: int, offset: int, length: int) -> bytes:
        """Return a property of one device or of all, cut to *length*."""
        number = group - IndexGroup.IO_DEVICES
        if not number:
            return self._read_all(offset)[:length]
        device = self._devices.get(number)
        if device is None:
            raise AdsRefusedError(AdsError.NOT_FOUND)
        reader = _OF_ONE.get(offset)
        if reader is None:
            raise AdsRefusedError(AdsError.INDEX_OFFSET)
        return reader(device)[:length]

    def _read_all(self, offset: int) -> bytes:
        count = len(self._devices)
        if offset == _Offset.COUNT:
            return count.to_bytes(4, "little")
        if offset == _Offset.IDS_OR_NAME:
            # The count is the first number of the list.
            return b"".join(number.to_bytes(2, "little") for number in (count, *self._devices))
        raise AdsRefusedError(AdsError.INDEX_OFFSET)


class NoSegmentSpace(AdsSpace):
    """Raw EtherCAT commands to a device that has no segment.

    They are answered as by a master with nothing connected: adstool, when it lists masters, asks
    every device that the I/O server has, and gives up at any other error (ECatAccess.cpp again).
    """

    groups: Collection[int] = frozenset((IndexGroup.RAW_COMMAND,))

    def read_write(self, group: int, offset: int, length: int, data: bytes) -> bytes:
        """Refuse with TIMEOUT."""
        del group, offset, length, data
        raise AdsRefusedError(AdsError.TIMEOUT, "no segment: this is no bus port")


_OF_ONE: dict[int, Callable[[IoDevice], bytes]] = {
    _Offset.IDS_OR_NAME: lambda device: encode_text(device.name) + b"\0",
    _Offset.NET_ID: lambda device: bytes(device.net_id),
    _Offset.TYPE: lambda device: device.type.to_bytes(2, "little"),
}


_STATE_OFFSET = 0x100
_AL_STATES = frozenset((INIT, PREOP, BOOT, SAFEOP, OP))


class SlaveState(NamedTuple):
    """One slave of the configuration."""

    address: int
    """Its station address."""
    state: int
    link: int


class MasterBus(Protocol):
    """Bus behind a master."""

    def state(self) -> int:
        """Return the AL state of the master itself."""

    def slaves(self) -> Sequence[SlaveState]:
        """Return all slaves of the configuration, in their order on the bus."""

    def request_state(self, state: int) -> None:
        """Have the master go to *state*, without waiting; raise AdsRefusedError."""

    def request_slave_state(self, address: int, state: int) -> None:
        """Have one slave go to *state*, without waiting; raise AdsRefusedError."""


class MasterSpace(AdsSpace):
    """The groups 3, 6, 7 and 9 of a master."""

    groups: Collection[int] = frozenset(
        (
            IndexGroup.MASTER_STATE,
            IndexGroup.SLAVE_COUNT,
            IndexGroup.SLAVE_ADDRESSES,
            IndexGroup.SLAVE_STATES,
        )
    )

    def __init__(self, master: MasterBus) -> None:
        self._master = master
        self._readers: dict[tuple[int, int], Callable[[], bytes]] = {
            (IndexGroup.MASTER_STATE, _STATE_OFFSET): self._state,
            (IndexGroup.SLAVE_COUNT, 0): self._count,
            (IndexGroup.SLAVE_ADDRESSES, 0): self._addresses,
            (IndexGroup.SLAVE_STATES, 0): self._states,
        }

    def read(self, group: int, offset: int, length: int) -> bytes:
        """Return states, addresses or their number; of lists as many as fit."""
        reader = self._readers.get((group, offset))
        if reader is not None:
            octets = reader()
            # Addresses and states have two bytes: none of them is cut.
            return octets[: min(length, len(octets)) // 2 * 2]
        if group != IndexGroup.SLAVE_STATES:
            raise AdsRefusedError(AdsError.INDEX_OFFSET)
        return _pair(self._slave(offset))[:length]

    def write(self, group: int, offset: int, data: bytes) -> None:
        """Request a state, of the master by the offset, of a slave by the two bytes written."""
        if group == IndexGroup.MASTER_STATE:
            # TwinCAT has the requested state of a master in the offset, that of a slave in the
            # data.
            self._master.request_state(_al_state(offset))
        elif group == IndexGroup.SLAVE_STATES:
            if len(data) != 2:
                raise AdsRefusedError(AdsError.SIZE)
            slave = self._slave(offset)
            state = _al_state(int.from_bytes(data, "little"))
            self._master.request_slave_state(slave.address, state)
        else:
            raise AdsRefusedError(AdsError.ACCESS)

    def watch(self, group: int, offset: int, length: int) -> Source:
        """Return a source of states; a list that gets shorter ends it."""
        return fixed_size_source(lambda: self.read(group, offset, length), length)

    def _slave(self, address: int) -> SlaveState:
        for slave in self._master.slaves():
            if slave.address == address:
                return slave
        raise AdsRefusedError(AdsError.INDEX_OFFSET)

    def _state(self) -> bytes:
        return self._master.state().to_bytes(2, "little")

    def _count(self) -> bytes:
        return len(self._master.slaves()).to_bytes(2, "little")

    def _addresses(self) -> bytes:
        return b"".join(slave.address.to_bytes(2, "little") for slave in self._master.slaves())

    def _states(self) -> bytes:
        return b"".join(map(_pair, self._master.slaves()))


def _pair(slave: SlaveState) -> bytes:
    return bytes((slave.state, slave.link))


def _al_state(number: int) -> int:
    if number not in _AL_STATES:
        raise AdsRefusedError(AdsError.VALUE)
    return number
