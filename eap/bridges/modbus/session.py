"""Answers to one Modbus client: reading and writing of the served coils and registers."""

from __future__ import annotations

from eap.bridges.field.memory import Denial, DeniedError, ServedMemory
from eap.bridges.field.protocol import FieldAnswer
from eap.codec.modbus import (
    ModbusException,
    ModbusFrame,
    ModbusFunction,
    ModbusMask,
    ModbusRead,
    ModbusReadWrite,
    ModbusRefusalError,
    ModbusTable,
    ModbusWrite,
    decode_request,
    encode_exception,
    encode_values,
    frame_length,
)

# 0 and 255 are what clients send that know no units: on TCP the address tells the device.
_NO_UNIT = frozenset((0, 255))
_EXCEPTIONS = {
    Denial.ADDRESS: ModbusException.ADDRESS,
    Denial.READ_ONLY: ModbusException.ADDRESS,
    Denial.VALUE: ModbusException.VALUE,
    Denial.NO_VALUE: ModbusException.FAILURE,
    Denial.REFUSED: ModbusException.FAILURE,
}


class ModbusSession:
    """One connection of a Modbus client (FieldSession).

    Args:
        memory: The served coils and registers.
        unit: The unit that they are.
    """

    def __init__(self, memory: ServedMemory, unit: int) -> None:
        self._memory = memory
        self._units = _NO_UNIT | {unit}

    def frame_length(self, buffer: bytes) -> int | None:
        """Return the length of the frame that *buffer* begins with, None until it is known."""
        return frame_length(buffer)

    def answer(self, frame: bytes) -> FieldAnswer[bytes]:
        """Answer one frame."""
        request = ModbusFrame.decode(frame)
        if request.unit not in self._units:
            pdu = encode_exception(request.pdu[0], ModbusException.NO_ANSWER)
        else:
            pdu = yield from self._pdu(request.pdu)
        return ModbusFrame(request.transaction, request.unit, pdu).encode()

    def _pdu(self, pdu: bytes) -> FieldAnswer[bytes]:
        try:
            request = decode_request(pdu)
            match request:
                case ModbusRead():
                    return encode_values(pdu[0], self._read(request))
                case ModbusWrite(table=table, first=first, number=count, data=data):
                    yield from self._write(table, first, count, data)
                    return request.reply()
                case ModbusMask(first=first, keep=keep, put=put):
                    before = self._read(ModbusRead(ModbusTable.HOLDING, first, 1))
                    now = int.from_bytes(before, "big") & keep | put & ~keep & 0xFFFF
                    yield from self._write(ModbusTable.HOLDING, first, 1, now.to_bytes(2, "big"))
                    return request.encode()
                case ModbusReadWrite(read=read, write=write):
                    yield from self._write(write.table, write.first, write.number, write.data)
                    function = ModbusFunction.READ_WRITE_REGISTERS
                    return encode_values(function, self._read(read))
        except ModbusRefusalError as exc:
            return encode_exception(pdu[0], exc.exception)
        except DeniedError as exc:
            return encode_exception(pdu[0], _EXCEPTIONS[exc.denial])

    def _read(self, request: ModbusRead) -> bytes:
        unit = request.table.unit_bits
        return self._memory.read(request.table, request.first * unit, request.number * unit)

    def _write(self, table: ModbusTable, first: int, count: int, data: bytes) -> FieldAnswer[None]:
        unit = table.unit_bits
        why = yield self._memory.changes(table, first * unit, count * unit, data)
        if why:
            raise DeniedError(Denial.REFUSED, why)
