"""Conversations with an S7 controller: connection, reading of items, writing of one item."""

from __future__ import annotations

from collections.abc import Sequence

from eap.bridges.field.plan import ReadSpan, SpanLimits, pieces
from eap.bridges.field.protocol import FieldConversation, FieldLinkError
from eap.codec.fieldaddresses import S7_AREAS, FieldPoint
from eap.codec.s7 import (
    HEADER_SIZE,
    ITEM_SIZE,
    MAX_ITEMS,
    REPLY_HEADER_SIZE,
    CotpConnect,
    CotpKind,
    ItemCode,
    ItemData,
    PduKind,
    S7Area,
    S7Function,
    S7Item,
    S7Pdu,
    data_item,
    decode_cotp,
    decode_item_data,
    decode_setup,
    encode_data,
    encode_item_data,
    encode_items,
    encode_setup,
    packet_length,
)
from eap.config.bridge_sections import S7Controller

WANTED_PDU = 960
"""Largest PDU of any controller."""
_MIN_PDU = 112
_TSAP = b"\x01\x00"
_PG = 1
"""Kind of connection in the controller's TSAP: programming device, which needs no set-up there."""
_ITEM_HEAD = 4
_GAP_BITS = 8 * 32
"""Gap that costs less than an item of its own would: its address, head and the time for it."""


class S7Link:
    """One connection to an S7 controller (FieldLink).

    Args:
        controller: Its rack and slot.
    """

    def __init__(self, controller: S7Controller) -> None:
        self._called = bytes((_PG, controller.rack << 5 | controller.slot))
        self._place = f"rack {controller.rack}, slot {controller.slot}"
        self._reference = 0
        self._pdu_size = _MIN_PDU
        self.limits = SpanLimits(self._most_bits, lambda _: _GAP_BITS)

    def frame_length(self, buffer: bytes) -> int | None:
        """Return the length of the packet that *buffer* begins with, None until it is known."""
        return packet_length(buffer)

    def open(self) -> FieldConversation[None]:
        """Open the connection and agree on the size of PDUs."""
        request = CotpConnect(CotpKind.REQUEST, 1, calling=_TSAP, called=self._called)
        reply = yield request.encode()
        if len(reply) > 5 and reply[5] & 0xF0 == CotpKind.DISCONNECT:
            raise FieldLinkError(f"the controller refuses the connection ({self._place})")
        if not isinstance(decode_cotp(reply), CotpConnect):
            raise FieldLinkError("the controller does not confirm the connection")
        pdu = yield from self._exchange(encode_setup(WANTED_PDU))
        size = decode_setup(pdu.parameters)
        if size < _MIN_PDU:
            raise FieldLinkError(f"the controller offers PDUs of {size} bytes only")
        self._pdu_size = min(size, WANTED_PDU)

    def fits(self, spans: Sequence[ReadSpan]) -> bool:
        """Return whether request and reply fit into a PDU."""
        data = sum(_ITEM_HEAD + _even(-(-span.bits // 8)) for span in spans)
        request = HEADER_SIZE + 2 + ITEM_SIZE * len(spans)
        reply = REPLY_HEADER_SIZE + 2 + data
        return len(spans) <= MAX_ITEMS and max(request, reply) <= self._pdu_size

    def read(self, spans: Sequence[ReadSpan]) -> FieldConversation[list[bytes | str]]:
        """Read spans by one request, a long one by several."""
        if len(spans) == 1 and spans[0].bits > (most := self._most_bits("")):
            return (yield from self._read_long(pieces(spans[0], most)))
        items = [_item(span.area, span.start, span.bits) for span in spans]
        pdu = yield from self._exchange(encode_items(S7Function.READ, items))
        found: list[bytes | str] = []
        for item, (code, data) in zip(items, decode_item_data(pdu.data, len(items)), strict=True):
            if code != ItemCode.DONE:
                found.append(ItemCode.words_of(code))
            elif len(data) < item.size:
                found.append(f"the controller sent {len(data)} of {item.size} bytes")
            else:
                found.append(data[: item.size])
        return found

    def _read_long(self, parts: Sequence[ReadSpan]) -> FieldConversation[list[bytes | str]]:
        data = bytearray()
        for part in parts:
            (found,) = yield from self.read([part])
            if isinstance(found, str):
                return [found]
            data += found
        return [bytes(data)]

    def write(self, point: FieldPoint, data: bytes) -> FieldConversation[str]:
        """Write one value."""
        # One item in a request: some servers store only the first and confirm all.
        item = _item(point.place.area, point.place.bit, point.type.bits)
        if REPLY_HEADER_SIZE + 2 + ITEM_SIZE + _ITEM_HEAD + len(data) > self._pdu_size:
            return f"{len(data)} bytes do not fit into a PDU of {self._pdu_size}"
        body = encode_item_data([(item, ItemData(ItemCode.DONE, data))], is_request=True)
        pdu = yield from self._exchange(encode_items(S7Function.WRITE, [item]), body)
        code = pdu.data[0] if pdu.data else ItemCode.HARDWARE
        return "" if code == ItemCode.DONE else ItemCode.words_of(code)

    def _exchange(self, parameters: bytes, data: bytes = b"") -> FieldConversation[S7Pdu]:
        self._reference = (self._reference + 1) & 0xFFFF
        request = S7Pdu(PduKind.JOB, self._reference, parameters, data)
        pdu = decode_cotp((yield encode_data(request)))
        if not isinstance(pdu, S7Pdu) or pdu.reference != self._reference:
            raise FieldLinkError("the controller replies to another request")
        if pdu.error:
            raise FieldLinkError(f"the controller refuses the request: error {pdu.error:#06x}")
        return pdu

    def _most_bits(self, area: str) -> int:
        del area
        return 8 * (self._pdu_size - REPLY_HEADER_SIZE - 2 - _ITEM_HEAD)


def _item(area: str, start: int, bits: int) -> S7Item:
    if area in S7_AREAS:
        return data_item(S7_AREAS[area], 0, start, bits)
    return data_item(S7Area.BLOCK, int(area.removeprefix("DB")), start, bits)


def _even(size: int) -> int:
    return size + size % 2
