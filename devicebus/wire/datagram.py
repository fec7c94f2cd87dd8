"""Datagrams of a type-1 frame, and the requests of a master with their replies.

DatagramRequest and DatagramReply are passed as they are, in MessagePack, between the processes that
share a master.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from enum import IntEnum
from typing import Annotated, NamedTuple

import msgspec

from eap.codec.ethercat import EtherCatHeader, FrameType
from eap.codec.wire import Buffer, Scalar, WireStruct, bit, bits3, bits11, u8, u16
from eap.errors import CodecError, MalformedError, TruncatedError


class Command(IntEnum):
    """ETG.1000.4: command of a datagram, its addressing and its direction."""

    NOP = 0
    APRD = 1
    APWR = 2
    APRW = 3
    FPRD = 4
    FPWR = 5
    FPRW = 6
    BRD = 7
    BWR = 8
    BRW = 9
    LRD = 10
    LWR = 11
    LRW = 12
    ARMW = 13
    FRMW = 14

    @property
    def is_logical(self) -> bool:
        """True if ADP and ADO are the two words of a logical address."""
        return self in _LOGICAL


_LOGICAL = frozenset((Command.LRD, Command.LWR, Command.LRW))


class DatagramHeader(WireStruct, frozen=True):
    """ETG.1000.4: header of a datagram, ten bytes in front of its data.

    *adp* is a position or a station address, *ado* a register offset; in logical commands they are
    the low and the high word of the address.  *more* says that another datagram follows.
    """

    command: Annotated[Command, Scalar("B", Command)]
    index: u8
    adp: u16
    ado: u16
    length: bits11
    reserved: bits3 = 0
    circulating: bit = 0
    more: bit = 0
    irq: u16 = 0

    @property
    def logical_address(self) -> int:
        """ADP and ADO as one address."""
        return self.ado << 16 | self.adp


class WorkingCounter(WireStruct, frozen=True):
    """ETG.1000.4: two bytes after a datagram's data, incremented by every slave that acts."""

    value: u16 = 0


OVERHEAD = DatagramHeader.SIZE + WorkingCounter.SIZE
"""Bytes of a datagram in addition to its data."""


class Datagram(NamedTuple):
    """One datagram of a frame; *data* is a view of the frame it was read from."""

    header: DatagramHeader
    data: bytes | memoryview
    wkc: int = 0


def iter_datagrams(frame: Buffer) -> Iterator[Datagram]:
    """Yield each datagram of a whole frame; nothing is copied.

    Bytes behind the last datagram are ignored.

    Raises:
        TruncatedError: the frame is shorter than its Length, or a datagram reaches past it.
        MalformedError: the frame is of another type, or a command is unknown.
    """
    ethercat = EtherCatHeader.decode(frame)
    if ethercat.type != FrameType.DATAGRAM:
        raise MalformedError(f"frame type {ethercat.type}, expected 1", layout="EtherCatHeader")
    end = EtherCatHeader.SIZE + ethercat.length
    if end > len(frame):
        raise TruncatedError(
            f"length {ethercat.length}, but {len(frame) - EtherCatHeader.SIZE} bytes follow",
            layout="EtherCatHeader",
        )
    # Ethernet padding may follow: only Length ends the frame.
    view = memoryview(frame)[:end]
    offset = EtherCatHeader.SIZE
    more = 1
    while more:
        header = DatagramHeader.decode(view, offset)
        start = offset + DatagramHeader.SIZE
        offset = start + header.length
        wkc = WorkingCounter.decode(view, offset).value
        yield Datagram(header, view[start:offset], wkc)
        offset += WorkingCounter.SIZE
        more = header.more


def encode_frame(datagrams: Sequence[Datagram]) -> bytes:
    """Return a whole frame; *length* and *more* of each datagram are set.

    Raises CodecError if there is no datagram or they do not fit the 11 bits of a Length.
    """
    if not datagrams:
        raise CodecError("a frame needs at least one datagram", layout="DatagramHeader")
    body = b""
    for number, (header, data, wkc) in enumerate(datagrams, 1):
        fixed = DatagramHeader(
            header.command,
            header.index,
            header.adp,
            header.ado,
            len(data),
            header.reserved,
            header.circulating,
            more=int(number < len(datagrams)),
            irq=header.irq,
        )
        body += fixed.encode() + data + WorkingCounter(wkc).encode()
    return EtherCatHeader(len(body), type=FrameType.DATAGRAM).encode() + body


# The records are array-like structs: they cross the processes' sockets for every datagram.
AS_SET = 0
"""Value of *tries* for the number of tries of the master's settings."""


class DatagramRequest(msgspec.Struct, frozen=True, array_like=True, gc=False):
    """One datagram to send; *data* is the data to write, or zeros in place of the reply.

    *tries* is 1 where a repetition does harm.
    """

    command: Command
    adp: int
    ado: int
    data: bytes
    tries: int = AS_SET


class DatagramReply(msgspec.Struct, frozen=True, array_like=True, gc=False):
    """Data and working counter of a datagram that came back."""

    data: bytes
    wkc: int
    tries: int = 1
    """Times the datagram was sent; after more than one, slaves may have acted more than once."""


def aprd(position: int, ado: int, size: int) -> DatagramRequest:
    """Read from the slave at a position in the segment, counted from 0."""
    # Each slave increments ADP, and the slave that receives 0 acts: position n is sent as -n.
    return DatagramRequest(Command.APRD, -position & 0xFFFF, ado, bytes(size))


def apwr(position: int, ado: int, data: bytes) -> DatagramRequest:
    """Write to the slave at a position in the segment, counted from 0."""
    return DatagramRequest(Command.APWR, -position & 0xFFFF, ado, data)


def fprd(station: int, ado: int, size: int, *, tries: int = AS_SET) -> DatagramRequest:
    """Read from the slave with a station address."""
    return DatagramRequest(Command.FPRD, station, ado, bytes(size), tries)


def fpwr(station: int, ado: int, data: bytes, *, tries: int = AS_SET) -> DatagramRequest:
    """Write to the slave with a station address."""
    return DatagramRequest(Command.FPWR, station, ado, data, tries)


def brd(ado: int, size: int) -> DatagramRequest:
    """Read from all slaves; the data is ORed."""
    return DatagramRequest(Command.BRD, 0, ado, bytes(size))


def bwr(ado: int, data: bytes) -> DatagramRequest:
    """Write to all slaves."""
    return DatagramRequest(Command.BWR, 0, ado, data)


def frmw(station: int, ado: int, size: int) -> DatagramRequest:
    """Read from one slave and write its data to all others; sent once, for a time value ages."""
    return DatagramRequest(Command.FRMW, station, ado, bytes(size), 1)


def logical(command: Command, address: int, data: bytes) -> DatagramRequest:
    """Read, write or both through the FMMUs; sent once, for the next cycle repeats it."""
    return DatagramRequest(command, address & 0xFFFF, address >> 16, data, 1)
