"""Conversations with a Modbus TCP device: reading of one span, writing of one value."""

from __future__ import annotations

from collections.abc import Sequence

from eap.bridges.field.plan import ReadSpan, SpanLimits, pieces
from eap.bridges.field.protocol import FieldConversation, FieldLinkError
from eap.codec.fieldaddresses import FieldPoint
from eap.codec.modbus import (
    MAX_BITS,
    MAX_REGISTERS,
    MAX_WRITTEN_REGISTERS,
    ModbusException,
    ModbusFrame,
    ModbusMask,
    ModbusRead,
    ModbusReply,
    ModbusTable,
    decode_reply,
    frame_length,
    write_request,
)
from eap.config.bridge_sections import ModbusController


class ModbusLink:
    """One connection to a Modbus TCP device (FieldLink).

    Args:
        controller: Its unit, and the gap between values that are read together.
    """

    def __init__(self, controller: ModbusController) -> None:
        self._unit = controller.unit
        self._transaction = 0
        gap = controller.gap
        self.limits = SpanLimits(_most_bits, lambda area: gap * ModbusTable(area).unit_bits)

    def frame_length(self, buffer: bytes) -> int | None:
        """Return the length of the frame that *buffer* begins with, None until it is known."""
        return frame_length(buffer)

    def open(self) -> FieldConversation[None]:
        """Begin: the protocol has no set-up."""
        yield from ()

    def fits(self, spans: Sequence[ReadSpan]) -> bool:
        """Return whether there is one span: a request reads one."""
        return len(spans) == 1

    def read(self, spans: Sequence[ReadSpan]) -> FieldConversation[list[bytes | str]]:
        """Read spans, one after the other."""
        found: list[bytes | str] = []
        for span in spans:
            data: bytes | str = b""
            # A value that is longer than a request takes several.
            for part in pieces(span, _most_bits(span.area)):
                more = yield from self._read(part)
                data = more if isinstance(more, str) or isinstance(data, str) else data + more
            found.append(data)
        return found

    def _read(self, span: ReadSpan) -> FieldConversation[bytes | str]:
        table = ModbusTable(span.area)
        unit = table.unit_bits
        request = ModbusRead(table, span.start // unit, span.bits // unit)
        reply = yield from self._exchange(request.encode())
        size = -(-span.bits // 8)
        if reply.exception:
            return ModbusException.words_of(reply.exception)
        if len(reply.data) < size:
            return f"the device sent {len(reply.data)} of {size} bytes"
        return reply.data[:size]

    def write(self, point: FieldPoint, data: bytes) -> FieldConversation[str]:
        """Write one value; a bit of a register by function 22, which leaves the others alone."""
        (area, start), kind = point
        table = ModbusTable(area)
        if not table.is_bits and kind.bits == 1:
            register, position = divmod(start, 16)
            mask = 1 << (position - 8 if position >= 8 else position + 8)
            pdu = ModbusMask(register, 0xFFFF & ~mask, mask if data[0] else 0).encode()
        else:
            unit = table.unit_bits
            if kind.bits // unit > MAX_WRITTEN_REGISTERS:
                return f"{kind.bits // unit} registers: at most {MAX_WRITTEN_REGISTERS}"
            pdu = write_request(table, start // unit, kind.bits // unit, data).encode()
        reply = yield from self._exchange(pdu)
        return ModbusException.words_of(reply.exception) if reply.exception else ""

    def _exchange(self, pdu: bytes) -> FieldConversation[ModbusReply]:
        self._transaction = (self._transaction + 1) & 0xFFFF
        frame = ModbusFrame.decode((yield ModbusFrame(self._transaction, self._unit, pdu).encode()))
        if frame.transaction != self._transaction:
            raise FieldLinkError("the device replies to another request")
        return decode_reply(frame.pdu, pdu)


def _most_bits(area: str) -> int:
    return MAX_BITS if ModbusTable(area).is_bits else 16 * MAX_REGISTERS
