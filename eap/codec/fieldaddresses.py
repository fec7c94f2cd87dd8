"""Addresses of values in S7 controllers and Modbus devices, as plant files write them.

A place is an area and a bit in it: of bytes that S7 numbers, of the big-endian bytes of registers,
or of coils.  So reading, writing and layout are the same for both protocols.
"""

from __future__ import annotations

import re
from typing import NamedTuple

from eap.codec.basetypes import DataType
from eap.codec.fieldtypes import (
    FieldBit,
    FieldNumber,
    FieldTime,
    FieldType,
    coil_type,
    modbus_type,
    s7_type,
)
from eap.codec.modbus import ModbusTable
from eap.codec.s7 import S7Area

S7_ADDRESS = "such as DB1.DBD4, DB1.DBX0.3 or MW10"
MODBUS_ADDRESS = "such as holding:100, input:7, coil:3 or holding:100.5 for one bit"
_BLOCK = re.compile(r"DB([0-9]{1,5})[.,] ?(?:DB)?([XBWD]?)([0-9]{1,5})(?:\.([0-7]))?", re.ASCII)
_MEMORY = re.compile(r"([IEQAM])([XBWD]?)([0-9]{1,5})(?:\.([0-7]))?", re.ASCII)
_REGISTER = re.compile(r"(coil|discrete|input|holding):([0-9]{1,5})(?:\.([0-9]{1,2}))?", re.ASCII)
_WIDTHS = {"": 0, "X": 1, "B": 8, "W": 16, "D": 32}
_AREAS = {"I": "I", "E": "I", "Q": "Q", "A": "Q", "M": "M"}
S7_AREAS = {"I": S7Area.INPUTS, "Q": S7Area.OUTPUTS, "M": S7Area.FLAGS}
"""Areas beside data blocks, by their letters."""
MAX_UNITS = 0x10000
"""Bytes of a data block, and addresses of a table."""


class FieldPlace(NamedTuple):
    """Start of a value: *bit* counts from the start of *area*.

    *area* is ``DB1``, ``I``, ``Q``, ``M``, or a table of Modbus.
    """

    area: str
    bit: int


class FieldPoint(NamedTuple):
    """A value on the other side."""

    place: FieldPlace
    type: FieldType

    @property
    def end(self) -> int:
        """Bit behind it."""
        return self.place.bit + self.type.bits


def unit_bits(area: str) -> int:
    """Return the bits of what an address in *area* counts: bytes, registers or coils."""
    return ModbusTable(area).unit_bits if area in _TABLES else 8


_TABLES = frozenset(ModbusTable)


def s7_point(kind: DataType, address: str, text: str = "") -> FieldPoint:
    """Return the value of a variable of type *kind* at an S7 address.

    Args:
        kind: Type of the variable.
        address: Such as ``DB1.DBD4``.
        text: Type in the controller, empty for that of the variable.

    Raises:
        ValueError: address or type is none, or they do not fit each other.
    """
    upper = address.strip().upper()
    if match := _BLOCK.fullmatch(upper):
        area = f"DB{int(match[1])}"
        if not 1 <= int(match[1]) <= 0xFFFF:
            raise ValueError(f"{address!r}: data blocks have numbers from 1 to 65535")
    elif match := _MEMORY.fullmatch(upper):
        area = _AREAS[match[1]]
    else:
        raise ValueError(f"{address!r} is no S7 address: expected one {S7_ADDRESS}")
    width, first, bit = _WIDTHS[match[2]], int(match[3]), match[4]
    field = s7_type(kind, text)
    if isinstance(field, FieldBit) is not (bit is not None):
        wanted = "a bit such as DB1.DBX0.3" if bit is None else "no bit"
        raise ValueError(f"{address!r} for {field.text}: expected {wanted}")
    # B is where longer values begin, too.
    if width > 8 and width != field.bits:
        hint = "" if text else "; type gives another one"
        raise ValueError(f"{address!r} has {width} bits, {field.text} has {field.bits}{hint}")
    return _within(address, FieldPoint(FieldPlace(area, 8 * first + int(bit or 0)), field))


def modbus_point(
    kind: DataType,
    address: str,
    text: str = "",
    *,
    words_swapped: bool = False,
    bytes_swapped: bool = False,
) -> FieldPoint:
    """Return the value of a variable of type *kind* at an address such as ``holding:100``.

    Args:
        kind: Type of the variable.
        address: Table, and number from 0 on as in requests; a bit of a register behind a dot.
        text: Type of the number in the registers, empty for that of the variable.
        words_swapped: As for :func:`modbus_type`.
        bytes_swapped: Likewise.

    Raises:
        ValueError: address or type is none, or they do not fit each other.
    """
    match = _REGISTER.fullmatch(address.strip().lower())
    if match is None:
        raise ValueError(f"{address!r} is no address: expected one {MODBUS_ADDRESS}")
    table, first, bit = ModbusTable(match[1]), int(match[2]), match[3]
    if table.is_bits or bit is not None:
        if text:
            raise ValueError(f"{address!r} is one bit: expected no type")
        if (table.is_bits and bit is not None) or int(bit or 0) > 15:
            raise ValueError(f"{address!r}: expected a bit from 0 to 15 of a register")
        place = FieldPlace(table, register_bit(first, int(bit)) if bit is not None else first)
        return _within(address, FieldPoint(place, coil_type(kind)))
    field = modbus_type(kind, text, words_swapped=words_swapped, bytes_swapped=bytes_swapped)
    return _within(address, FieldPoint(FieldPlace(table, 16 * first), field))


def register_bit(register: int, bit: int) -> int:
    """Return the position of a bit of a register: bit 0 is in its second byte."""
    return 16 * register + (bit + 8 if bit < 8 else bit - 8)


def _within(address: str, point: FieldPoint) -> FieldPoint:
    if point.end > MAX_UNITS * unit_bits(point.place.area):
        raise ValueError(f"{address!r} with {point.type.text} ends behind the last address")
    return point


def place_text(point: FieldPoint) -> str:
    """Return the address in the notation of plant files."""
    (area, start), field = point
    if area in _TABLES:
        if ModbusTable(area).is_bits:
            return f"{area}:{start}"
        register, rest = divmod(start, 16)
        bit = f".{rest - 8 if rest >= 8 else rest + 8}" if field.bits == 1 else ""
        return f"{area}:{register}{bit}"
    first, bit_number = divmod(start, 8)
    letter = {1: "X", 16: "W", 32: "D"}.get(field.bits, "B")
    if not isinstance(field, FieldBit | FieldNumber | FieldTime):
        letter = "B"
    end = f".{bit_number}" if field.bits == 1 else ""
    if area.startswith("DB"):
        return f"{area}.DB{letter}{first}{end}"
    return f"{area}{'' if letter == 'X' else letter}{first}{end}"
