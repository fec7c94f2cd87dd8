"""Modbus TCP: the MBAP header, and the requests that read and write data.

Modbus Application Protocol V1.1b3 and Modbus Messaging on TCP/IP V1.0b.  Everything is big-endian;
of bits the first one is the lowest of its byte.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from enum import IntEnum, StrEnum
from typing import NamedTuple

from eap.codec.wire import Buffer
from eap.errors import CodecError, MalformedError, TruncatedError

MODBUS_PORT = 502
MBAP_SIZE = 7
MAX_PDU = 253
MAX_REGISTERS, MAX_WRITTEN_REGISTERS = 125, 123
"""Registers in one request that reads, and that writes."""
MAX_BITS, MAX_WRITTEN_BITS = 2000, 1968
_EXCEPTION = 0x80
_ON = 0xFF00


class ModbusTable(StrEnum):
    """Memory of a device."""

    COILS = "coil"
    DISCRETE = "discrete"
    INPUT = "input"
    HOLDING = "holding"

    @property
    def is_bits(self) -> bool:
        """True if it consists of single bits, else of 16-bit registers."""
        return self in {ModbusTable.COILS, ModbusTable.DISCRETE}

    @property
    def unit_bits(self) -> int:
        """Bits of what an address counts."""
        return 1 if self.is_bits else 16


class ModbusFunction(IntEnum):
    """Function code."""

    READ_COILS = 1
    READ_DISCRETE = 2
    READ_HOLDING = 3
    READ_INPUT = 4
    WRITE_COIL = 5
    WRITE_REGISTER = 6
    WRITE_COILS = 15
    WRITE_REGISTERS = 16
    MASK_REGISTER = 22
    READ_WRITE_REGISTERS = 23


class ModbusException(IntEnum):
    """Reason of a refused request."""

    FUNCTION = 1
    ADDRESS = 2
    VALUE = 3
    FAILURE = 4
    ACKNOWLEDGE = 5
    BUSY = 6
    PARITY = 8
    NO_PATH = 10
    NO_ANSWER = 11

    @classmethod
    def words_of(cls, code: int) -> str:
        """Return the meaning of a code that a device sent."""
        return _WORDS.get(code, f"exception {code}")


_WORDS: dict[int, str] = {
    ModbusException.FUNCTION: "illegal function",
    ModbusException.ADDRESS: "illegal data address",
    ModbusException.VALUE: "illegal data value",
    ModbusException.FAILURE: "device failure",
    ModbusException.ACKNOWLEDGE: "the device is busy with the request",
    ModbusException.BUSY: "the device is busy",
    ModbusException.PARITY: "memory parity error",
    ModbusException.NO_PATH: "gateway path unavailable",
    ModbusException.NO_ANSWER: "the device behind the gateway does not answer",
}

READS = {
    ModbusTable.COILS: ModbusFunction.READ_COILS,
    ModbusTable.DISCRETE: ModbusFunction.READ_DISCRETE,
    ModbusTable.HOLDING: ModbusFunction.READ_HOLDING,
    ModbusTable.INPUT: ModbusFunction.READ_INPUT,
}
_TABLES: dict[int, ModbusTable] = {function: table for table, function in READS.items()}


class ModbusFrame(NamedTuple):
    """One frame."""

    transaction: int
    unit: int
    pdu: bytes

    def encode(self) -> bytes:
        """Return the frame."""
        head = self.transaction, 0, len(self.pdu) + 1, self.unit
        return struct.pack(">HHHB", *head) + self.pdu

    @classmethod
    def decode(cls, frame: bytes) -> ModbusFrame:
        """Read a whole frame, as :func:`frame_length` delimits it."""
        transaction, _, _, unit = struct.unpack_from(">HHHB", frame)
        return cls(transaction, unit, frame[MBAP_SIZE:])


def frame_length(buffer: Buffer) -> int | None:
    """Return the length of the frame that *buffer* begins with, None if its header is not there.

    Raises:
        MalformedError: there is no frame, or it is too long.
    """
    if len(buffer) < 6:
        return None
    _, protocol, length = struct.unpack_from(">HHH", buffer)
    # The length counts the unit identifier, too.
    if protocol or not 2 <= length <= MAX_PDU + 1:
        raise MalformedError(f"protocol {protocol}, length {length}", layout="MBAP")
    return 6 + int(length)


class ModbusRead(NamedTuple):
    """Reading of *number* bits or registers from *first* on."""

    table: ModbusTable
    first: int
    number: int

    def encode(self) -> bytes:
        """Return the PDU."""
        return struct.pack(">BHH", READS[self.table], self.first, self.number)


class ModbusWrite(NamedTuple):
    """Writing of *number* coils or registers from *first* on; *function* is the request's."""

    table: ModbusTable
    first: int
    number: int
    data: bytes
    function: int

    def encode(self) -> bytes:
        """Return the PDU."""
        if self.function == ModbusFunction.WRITE_COIL:
            return struct.pack(">BHH", self.function, self.first, _ON if self.data[0] & 1 else 0)
        if self.function == ModbusFunction.WRITE_REGISTER:
            return struct.pack(">BH", self.function, self.first) + self.data
        head = self.function, self.first, self.number, len(self.data)
        return struct.pack(">BHHB", *head) + self.data

    def reply(self) -> bytes:
        """Return the PDU of its confirmation."""
        if self.function in {ModbusFunction.WRITE_COIL, ModbusFunction.WRITE_REGISTER}:
            return self.encode()
        return struct.pack(">BHH", self.function, self.first, self.number)


class ModbusMask(NamedTuple):
    """Change of one holding register: its bits AND *keep*, OR those of *put* that are not kept."""

    first: int
    keep: int
    put: int

    def encode(self) -> bytes:
        """Return the PDU, which also confirms it."""
        return struct.pack(">BHHH", ModbusFunction.MASK_REGISTER, self.first, self.keep, self.put)


class ModbusReadWrite(NamedTuple):
    """Writing of holding registers, then reading of others."""

    read: ModbusRead
    write: ModbusWrite


ModbusRequest = ModbusRead | ModbusWrite | ModbusMask | ModbusReadWrite


def write_request(table: ModbusTable, first: int, count: int, data: bytes) -> ModbusWrite:
    """Return the request that writes: the one for a single value where it is one."""
    # Small devices often lack the functions for several values.
    if table is ModbusTable.COILS:
        function = ModbusFunction.WRITE_COIL if count == 1 else ModbusFunction.WRITE_COILS
    else:
        function = ModbusFunction.WRITE_REGISTER if count == 1 else ModbusFunction.WRITE_REGISTERS
    return ModbusWrite(table, first, count, data, function)


class ModbusRefusalError(CodecError):
    """A request that has to be answered by an exception.

    Attributes:
        exception: Its code.
    """

    def __init__(self, exception: ModbusException, why: str) -> None:
        super().__init__(why, layout="Modbus")
        self.exception = exception


def decode_request(pdu: bytes) -> ModbusRequest:
    """Read a request.

    Raises:
        ModbusRefusalError: it is none, or not supported; its exception is the answer.
    """
    function = pdu[0]
    try:
        if function in _TABLES:
            first, count = struct.unpack(">HH", pdu[1:])
            return _checked_read(_TABLES[function], first, count)
        if function in _WRITES:
            return _WRITES[function](pdu)
        if function == ModbusFunction.MASK_REGISTER:
            return ModbusMask(*struct.unpack(">HHH", pdu[1:]))
        if function == ModbusFunction.READ_WRITE_REGISTERS:
            first, count = struct.unpack_from(">HH", pdu, 1)
            read = _checked_read(ModbusTable.HOLDING, first, count)
            return ModbusReadWrite(read, _written(ModbusTable.HOLDING, function, pdu, 5))
    # Surplus bytes count as wrong, too: the master means something that this does not know.
    except (struct.error, IndexError):
        why = f"function {function} with {len(pdu)} bytes"
        raise ModbusRefusalError(ModbusException.VALUE, why) from None
    raise ModbusRefusalError(ModbusException.FUNCTION, f"function {function}")


def _checked_read(table: ModbusTable, first: int, count: int) -> ModbusRead:
    most = MAX_BITS if table.is_bits else MAX_REGISTERS
    if not 1 <= count <= most:
        raise ModbusRefusalError(ModbusException.VALUE, f"{count} values, at most {most}")
    return ModbusRead(table, first, count)


def _write_coil(pdu: bytes) -> ModbusWrite:
    first, value = struct.unpack(">HH", pdu[1:])
    # The standard has no third value: a device that took any as "on" would hide a wrong master.
    if value not in {0, _ON}:
        raise ModbusRefusalError(ModbusException.VALUE, f"coil value {value:#06x}")
    return ModbusWrite(ModbusTable.COILS, first, 1, bytes((value == _ON,)), pdu[0])


def _write_register(pdu: bytes) -> ModbusWrite:
    first, _ = struct.unpack(">HH", pdu[1:])
    return ModbusWrite(ModbusTable.HOLDING, first, 1, pdu[3:5], pdu[0])


def _written(table: ModbusTable, function: int, pdu: bytes, at: int) -> ModbusWrite:
    first, count, size = struct.unpack_from(">HHB", pdu, at)
    data = pdu[at + 5 :]
    most = MAX_WRITTEN_BITS if table.is_bits else MAX_WRITTEN_REGISTERS
    needed = -(-count // 8) if table.is_bits else 2 * count
    # Count and length say the same twice: where they differ, writing a part would be a guess.
    if not 1 <= count <= most or size != needed or len(data) != needed:
        why = f"{count} values in {len(data)} bytes"
        raise ModbusRefusalError(ModbusException.VALUE, why)
    return ModbusWrite(table, first, count, data, function)


_WRITES: dict[int, Callable[[bytes], ModbusWrite]] = {
    ModbusFunction.WRITE_COIL: _write_coil,
    ModbusFunction.WRITE_REGISTER: _write_register,
    ModbusFunction.WRITE_COILS: lambda pdu: _written(ModbusTable.COILS, pdu[0], pdu, 1),
    ModbusFunction.WRITE_REGISTERS: lambda pdu: _written(ModbusTable.HOLDING, pdu[0], pdu, 1),
}


def encode_exception(function: int, exception: ModbusException) -> bytes:
    """Return the PDU of a refusal."""
    return bytes((function | _EXCEPTION, exception))


def encode_values(function: int, data: bytes) -> bytes:
    """Return the PDU of values that were read."""
    return bytes((function, len(data))) + data


class ModbusReply(NamedTuple):
    """Reply of a device: *data* of a read, or an exception."""

    data: bytes = b""
    exception: int = 0


def decode_reply(pdu: bytes, request: bytes) -> ModbusReply:
    """Read the reply to *request*.

    Raises:
        CodecError: it is the reply to another request, or incomplete.
    """
    function = request[0]
    # Exceptions are looked for first: their function code differs from the request, too.
    if len(pdu) >= 2 and pdu[0] == function | _EXCEPTION:
        return ModbusReply(exception=pdu[1])
    if not pdu or pdu[0] != function:
        raise MalformedError(f"reply {pdu[:2].hex()} to function {function}", layout="Modbus")
    # A confirmation of a write repeats the request and says nothing more.
    if function not in _TABLES:
        return ModbusReply()
    if len(pdu) < 2 or len(pdu) < 2 + pdu[1]:
        raise TruncatedError(f"{len(pdu)} bytes", layout="Modbus")
    return ModbusReply(pdu[2 : 2 + pdu[1]])
