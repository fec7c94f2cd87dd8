"""The ADS services that read and write: what follows the AMS header, and the result codes.

Beckhoff ADS specification.  A request names a value by index group and index offset; every answer
begins with a result of 32 bits.
"""

from __future__ import annotations

from enum import IntEnum

from eap.codec.wire import WireStruct, u32


class AdsError(IntEnum):
    """Results of a service, and the errors in an AMS header that mean the way to it."""

    NONE = 0x000
    INTERNAL = 0x001
    MAILBOX_FULL = 0x004
    TARGET_PORT = 0x006
    TARGET_MACHINE = 0x007
    COMMAND = 0x008
    AMS_LENGTH = 0x00E
    HOST_UNREACHABLE = 0x01B
    FRAGMENT = 0x01C
    GENERAL = 0x700
    SERVICE = 0x701
    INDEX_GROUP = 0x702
    INDEX_OFFSET = 0x703
    ACCESS = 0x704
    SIZE = 0x705
    VALUE = 0x706
    BUSY = 0x708
    NO_MEMORY = 0x70A
    NOT_FOUND = 0x70C
    STATE = 0x712
    TIMEOUT = 0x719
    ACCESS_DENIED = 0x723


class IndexGroup(IntEnum):
    """ETG.1020, AoE: what a slave shows of itself."""

    ADDRESS = 0x0001
    """Written with offset 3: the NetID of the slave."""
    SDO = 0xF302
    """Offset: index in the high word, bit 8 complete access, bits 0 to 7 subindex."""
    OBJECT_LIST = 0xF3FC
    """Offset: type of the list in the high word."""
    OBJECT_DESCRIPTION = 0xF3FD
    ENTRY_DESCRIPTION = 0xF3FE
    """Offset: index in the high word, bits 8 to 15 value info, bits 0 to 7 subindex."""


class AdsRange(WireStruct, frozen=True):
    """Request of Read, and the head of a Write before its data; *length* is in octets."""

    group: u32
    offset: u32
    length: u32


class AdsReadWrite(WireStruct, frozen=True):
    """Head of a ReadWrite before the data that it writes; lengths are in octets."""

    group: u32
    offset: u32
    read_length: u32
    write_length: u32


def encode_result(result: int, data: bytes | None = None) -> bytes:
    """Return the body of an answer; with *data* that of a Read or ReadWrite."""
    octets = result.to_bytes(4, "little")
    return octets if data is None else octets + len(data).to_bytes(4, "little") + data
