"""Datagrams that a master sends to slaves, and their replies.

The records travel as they are, in MessagePack, between the processes that share a master.
"""

from __future__ import annotations

import msgspec

from devicebus.wire.datagram import Command

AS_SET = 0
"""Tries of a datagram that is sent as often as the master's settings say."""


class DatagramRequest(msgspec.Struct, frozen=True, array_like=True, gc=False):
    """One datagram to send; *data* is what is written, or zeros where the reply goes.

    *tries* is 1 where sending it twice would do harm.
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
    """Times it was sent: with more than one, slaves may have acted more than once."""


def aprd(position: int, ado: int, size: int) -> DatagramRequest:
    """Read from the slave at a position of the line, counted from 0."""
    return DatagramRequest(Command.APRD, -position & 0xFFFF, ado, bytes(size))


def apwr(position: int, ado: int, data: bytes) -> DatagramRequest:
    """Write to the slave at a position of the line, counted from 0."""
    return DatagramRequest(Command.APWR, -position & 0xFFFF, ado, data)


def fprd(station: int, ado: int, size: int, *, tries: int = AS_SET) -> DatagramRequest:
    """Read from the slave with a station address."""
    return DatagramRequest(Command.FPRD, station, ado, bytes(size), tries)


def fpwr(station: int, ado: int, data: bytes, *, tries: int = AS_SET) -> DatagramRequest:
    """Write to the slave with a station address."""
    return DatagramRequest(Command.FPWR, station, ado, data, tries)


def brd(ado: int, size: int) -> DatagramRequest:
    """Read from all slaves; what they have is ORed."""
    return DatagramRequest(Command.BRD, 0, ado, bytes(size))


def bwr(ado: int, data: bytes) -> DatagramRequest:
    """Write to all slaves."""
    return DatagramRequest(Command.BWR, 0, ado, data)


def frmw(station: int, ado: int, size: int) -> DatagramRequest:
    """Read from one slave and write what it has to all others; sent once, as it ages."""
    return DatagramRequest(Command.FRMW, station, ado, bytes(size), 1)


def logical(command: Command, address: int, data: bytes) -> DatagramRequest:
    """Read, write or both through the FMMUs; sent once, for the next cycle sends it anew."""
    return DatagramRequest(command, address & 0xFFFF, address >> 16, data, 1)
