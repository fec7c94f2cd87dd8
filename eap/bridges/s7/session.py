"""Answers to one S7 client: connection, reading and writing of items of the served blocks."""

from __future__ import annotations

from eap.bridges.field.memory import Denial, DeniedError, ServedMemory
from eap.bridges.field.protocol import FieldAnswer
from eap.codec.fieldaddresses import S7_AREAS
from eap.codec.s7 import (
    HEADER_SIZE,
    NOT_SUPPORTED,
    REPLY_HEADER_SIZE,
    TOO_LONG,
    CotpConnect,
    CotpKind,
    ItemCode,
    ItemData,
    PduKind,
    S7Area,
    S7Function,
    S7Item,
    S7Pdu,
    decode_cotp,
    decode_item_data,
    decode_items,
    decode_setup,
    encode_data,
    encode_item_data,
    encode_setup,
    packet_length,
)
from eap.errors import MalformedError

MAX_PDU = 960
_MIN_PDU = 112
_MAX_JOBS = 8
_COTP_DATA = 3
_LETTERS = {area: letter for letter, area in S7_AREAS.items()}
_CODES = {
    Denial.ADDRESS: ItemCode.ADDRESS,
    Denial.READ_ONLY: ItemCode.DENIED,
    Denial.VALUE: ItemCode.SIZE,
    Denial.NO_VALUE: ItemCode.HARDWARE,
    Denial.REFUSED: ItemCode.DENIED,
}


class S7Session:
    """One connection of an S7 client (FieldSession).

    Rack and slot of the client are taken as they come: there is one controller here.

    Args:
        memory: The served blocks.
    """

    def __init__(self, memory: ServedMemory) -> None:
        self._memory = memory
        self._largest = MAX_PDU
        self._pdu_size = _MIN_PDU

    def frame_length(self, buffer: bytes) -> int | None:
        """Return the length of the packet that *buffer* begins with, None until it is known."""
        return packet_length(buffer)

    def answer(self, frame: bytes) -> FieldAnswer[bytes]:
        """Answer one packet."""
        request = decode_cotp(frame)
        if isinstance(request, CotpConnect):
            return self._connect(request)
        if request.kind == PduKind.USER_DATA:
            return encode_data(_refuse_user_data(request))
        if request.kind != PduKind.JOB or not request.parameters:
            raise MalformedError(f"PDU of kind {request.kind}", layout="S7")
        if len(request.parameters) + len(request.data) + HEADER_SIZE > MAX_PDU:
            return encode_data(_refusal(request, TOO_LONG))
        function = request.parameters[0]
        if function == S7Function.SETUP:
            reply = self._setup(request)
        elif function == S7Function.READ:
            reply = self._read(request)
        elif function == S7Function.WRITE:
            reply = yield from self._write(request)
        else:
            reply = _refusal(request, NOT_SUPPORTED)
        return encode_data(reply)

    def _connect(self, request: CotpConnect) -> bytes:
        if request.kind != CotpKind.REQUEST:
            raise MalformedError(f"COTP packet {request.kind:#04x} of a client", layout="COTP")
        size = min(request.tpdu_size, 1024)
        # A PDU is never divided into several packets.
        self._largest = min(MAX_PDU, size - _COTP_DATA)
        confirm = CotpConnect(
            CotpKind.CONFIRM, 1, request.source, request.calling, request.called, size
        )
        return confirm.encode()

    def _setup(self, request: S7Pdu) -> S7Pdu:
        wanted = decode_setup(request.parameters)
        self._pdu_size = max(min(wanted, self._largest), _MIN_PDU)
        jobs = int.from_bytes(request.parameters[2:4], "big")
        parameters = encode_setup(self._pdu_size, max(1, min(jobs, _MAX_JOBS)))
        return S7Pdu(PduKind.ACK_DATA, request.reference, parameters)

    def _read(self, request: S7Pdu) -> S7Pdu:
        items = decode_items(request.parameters)
        if REPLY_HEADER_SIZE + 2 + sum(4 + each.size for each in items) > self._pdu_size:
            return _refusal(request, TOO_LONG)
        found = [(item, self._item(item)) for item in items]
        parameters = bytes((S7Function.READ, len(items)))
        return S7Pdu(PduKind.ACK_DATA, request.reference, parameters, encode_item_data(found))

    def _item(self, item: S7Item) -> ItemData:
        if (code := self._code_of(item)) is not None:
            return ItemData(code)
        try:
            return ItemData(ItemCode.DONE, self._memory.read(_area(item), item.start, item.bits))
        except DeniedError as exc:
            return ItemData(_CODES[exc.denial])

    def _write(self, request: S7Pdu) -> FieldAnswer[S7Pdu]:
        items = decode_items(request.parameters)
        data = decode_item_data(request.data, len(items))
        codes = bytearray()
        # Each item is written and confirmed for itself, as controllers do.
        for item, (_, octets) in zip(items, data, strict=True):
            codes.append((yield from self._write_item(item, octets)))
        parameters = bytes((S7Function.WRITE, len(items)))
        return S7Pdu(PduKind.ACK_DATA, request.reference, parameters, bytes(codes))

    def _write_item(self, item: S7Item, data: bytes) -> FieldAnswer[ItemCode]:
        if (code := self._code_of(item)) is not None:
            return code
        if len(data) != item.size:
            return ItemCode.SIZE
        try:
            changes = self._memory.changes(_area(item), item.start, item.bits, data)
        except DeniedError as exc:
            return _CODES[exc.denial]
        why = yield changes
        return ItemCode.DENIED if why else ItemCode.DONE

    def _code_of(self, item: S7Item) -> ItemCode | None:
        """Return the code of an item that is none of the memory at all."""
        if not item.bits or (item.is_bit and item.number != 1):
            return ItemCode.TYPE
        if not item.is_bit and item.start % 8:
            return ItemCode.ADDRESS
        return None if self._memory.has_area(_area(item)) else ItemCode.MISSING


def _area(item: S7Item) -> str:
    if item.area == S7Area.BLOCK:
        return f"DB{item.block}"
    return _LETTERS.get(item.area, "")  # type: ignore[call-overload, no-any-return]


def _refusal(request: S7Pdu, error: int) -> S7Pdu:
    return S7Pdu(PduKind.ACK_DATA, request.reference, request.parameters[:2], error=error)


def _refuse_user_data(request: S7Pdu) -> S7Pdu:
    """Return the reply to a request that is not about data: system status lists, blocks, clock."""
    # Head, length, method, type and group with the response bit, subfunction, sequence, unit of
    # data, last unit, error: "not available".
    group = (request.parameters[5] if len(request.parameters) > 5 else 0) & 0x0F | 0x80
    sub = request.parameters[6] if len(request.parameters) > 6 else 0
    parameters = bytes((0, 1, 0x12, 8, 0x12, group, sub, 0, 0, 0, 0xD4, 0x01))
    return S7Pdu(PduKind.USER_DATA, request.reference, parameters, b"\x0a\0\0\0")
