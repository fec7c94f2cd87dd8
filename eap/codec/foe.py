"""FoE messages: files over EtherCAT (ETG.1000.6), one message after the other in TFTP's manner."""

from __future__ import annotations

from enum import IntEnum
from typing import Annotated, NamedTuple

from eap.codec.wire import Buffer, Scalar, WireStruct, u8, u32

DATA_OVERHEAD = 12
"""Bytes of a mailbox that a DATA message takes before its data."""


class FoeOpcode(IntEnum):
    """ETG.1000.6, FoE header: what a message is."""

    READ = 1
    WRITE = 2
    DATA = 3
    ACK = 4
    ERROR = 5
    BUSY = 6


class FoeErrorCode(IntEnum):
    """ETG.1000.6, FoE error codes; a peer may send others, which stay plain integers."""

    NOT_DEFINED = 0x8000
    NOT_FOUND = 0x8001
    ACCESS_DENIED = 0x8002
    DISK_FULL = 0x8003
    ILLEGAL = 0x8004
    PACKET_NUMBER = 0x8005
    ALREADY_EXISTS = 0x8006
    NO_USER = 0x8007
    BOOTSTRAP_ONLY = 0x8008
    NOT_IN_BOOTSTRAP = 0x8009
    NO_RIGHTS = 0x800A
    PROGRAM_ERROR = 0x800B
    CHECKSUM = 0x800C


_TEXTS = {
    FoeErrorCode.NOT_DEFINED: "error without a reason",
    FoeErrorCode.NOT_FOUND: "file not found",
    FoeErrorCode.ACCESS_DENIED: "access denied",
    FoeErrorCode.DISK_FULL: "disk full",
    FoeErrorCode.ILLEGAL: "illegal operation",
    FoeErrorCode.PACKET_NUMBER: "wrong packet number",
    FoeErrorCode.ALREADY_EXISTS: "file already exists",
    FoeErrorCode.NO_USER: "no user",
    FoeErrorCode.BOOTSTRAP_ONLY: "only in state BOOT",
    FoeErrorCode.NOT_IN_BOOTSTRAP: "not in state BOOT",
    FoeErrorCode.NO_RIGHTS: "no rights",
    FoeErrorCode.PROGRAM_ERROR: "program error",
    FoeErrorCode.CHECKSUM: "wrong checksum",
}


def name_of(code: int) -> str:
    """Return the meaning of *code*, which may be of the vendor."""
    try:
        return _TEXTS[FoeErrorCode(code)]
    except ValueError:
        return "error code of the vendor"


class FoeHeader(WireStruct, frozen=True):
    """ETG.1000.6: the six bytes behind the mailbox header.

    *number* is a password, a packet number, an error code, or how far a busy peer is.
    """

    opcode: Annotated[FoeOpcode, Scalar("B", FoeOpcode)]
    reserved: u8 = 0
    number: u32 = 0


class Busy(NamedTuple):
    """Progress of a busy peer: *done* of *entire*, both up to 65535, in a unit of its own."""

    done: int
    entire: int

    @classmethod
    def of(cls, number: int) -> Busy:
        """Take the two words of a BUSY message apart."""
        # The standard has no unit for them: only their ratio says anything.
        return cls(number & 0xFFFF, number >> 16)

    @property
    def number(self) -> int:
        """The two words as the header carries them."""
        return self.entire << 16 | self.done


def encode_message(opcode: FoeOpcode, number: int, body: Buffer = b"") -> bytes:
    """Return the data of a mailbox message."""
    return FoeHeader(opcode, number=number).encode() + body


def decode_message(data: Buffer) -> tuple[FoeHeader, memoryview]:
    """Return header and body of the data of a mailbox message.

    Raises:
        TruncatedError: it is shorter than the header.
        MalformedError: the opcode is unknown.
    """
    return FoeHeader.decode(data), memoryview(data)[FoeHeader.SIZE :]


def text_of(body: Buffer) -> str:
    """Return the file name or error text of a body; NULs that end it are no part of it."""
    # SOEM sends file names without a NUL; other peers end them with one.
    return bytes(body).rstrip(b"\0").decode(errors="replace")
