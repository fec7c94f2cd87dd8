"""One access to slaves: what becomes a datagram, and what comes back of it."""

from __future__ import annotations

from typing import NamedTuple

from devicebus.wire.datagram import Command

AS_SET = 0
"""Tries of a datagram that is sent as often as the master's settings say."""


class Access(NamedTuple):
    """One datagram to send; *data* is what is written, or zeros where the reply goes.

    *tries* is 1 where sending it twice would do harm.
    """

    command: Command
    adp: int
    ado: int
    data: bytes
    tries: int = AS_SET


class Reply(NamedTuple):
    """What came back of an access."""

    data: bytes
    wkc: int
    tries: int = 1
    """How often it was sent: with more than one, slaves may have acted more than once."""


def aprd(position: int, ado: int, size: int) -> Access:
    """Read from the slave at a position of the line, counted from 0."""
    return Access(Command.APRD, -position & 0xFFFF, ado, bytes(size))


def apwr(position: int, ado: int, data: bytes) -> Access:
    """Write to the slave at a position of the line, counted from 0."""
    return Access(Command.APWR, -position & 0xFFFF, ado, data)


def fprd(station: int, ado: int, size: int, *, tries: int = AS_SET) -> Access:
    """Read from the slave with a station address."""
    return Access(Command.FPRD, station, ado, bytes(size), tries)


def fpwr(station: int, ado: int, data: bytes, *, tries: int = AS_SET) -> Access:
    """Write to the slave with a station address."""
    return Access(Command.FPWR, station, ado, data, tries)


def brd(ado: int, size: int) -> Access:
    """Read from all slaves; what they have is ORed."""
    return Access(Command.BRD, 0, ado, bytes(size))


def bwr(ado: int, data: bytes) -> Access:
    """Write to all slaves."""
    return Access(Command.BWR, 0, ado, data)


def frmw(station: int, ado: int, size: int) -> Access:
    """Read from one slave and write what it has to all others; sent once, as it ages."""
    return Access(Command.FRMW, station, ado, bytes(size), 1)


def logical(command: Command, address: int, data: bytes) -> Access:
    """Read, write or both through the FMMUs; sent once, for the next cycle sends it anew."""
    return Access(command, address & 0xFFFF, address >> 16, data, 1)
