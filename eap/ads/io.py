"""The I/O server behind port 300: the list of a station's ports, as TwinCAT lists its devices.

The groups are those that Beckhoff's adstool asks for (ECatAccess.cpp of AdsLib), the numbers of
types those of TwinCAT's TCatSysManagerLib.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable
from enum import IntEnum
from typing import NamedTuple

from eap.ads.operation import AdsRefusedError
from eap.ads.space import AdsSpace
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
    """The list of devices; *devices* come in the order in which they are told."""

    groups: Collection[int] = range(IndexGroup.IO_DEVICES, IndexGroup.IO_DEVICES + _MAX_ID + 1)

    def __init__(self, devices: Iterable[IoDevice]) -> None:
        self._devices = {device.id: device for device in devices}

    def read(self, group: int, offset: int, length: int) -> bytes:
        """Return what is asked of one device or of all, cut to *length*."""
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
