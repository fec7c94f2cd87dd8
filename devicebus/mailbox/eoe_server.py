"""EoE on the side of a slave: its IP settings, and Ethernet frames to and from it (ETG.1000.6)."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

import msgspec

from devicebus.mailbox.eoe_fragment import Assembler, iter_fragments
from devicebus.mailbox.protocol import MailboxSizes, readable, refuse
from eap.codec.eoe import (
    DATA_OVERHEAD,
    EoeHeader,
    EoeResult,
    EoeType,
    IpSettings,
    decode_message,
    encode_message,
)
from eap.codec.mailbox import MailboxError
from eap.errors import CodecError

MAX_PENDING = 64
"""Fragments that wait for the master; a frame that would exceed them is dropped and counted."""
_RESPONSE = {
    EoeType.SET_IP_REQUEST: EoeType.SET_IP_RESPONSE,
    EoeType.GET_IP_REQUEST: EoeType.GET_IP_RESPONSE,
    EoeType.SET_FILTER_REQUEST: EoeType.SET_FILTER_RESPONSE,
    EoeType.GET_FILTER_REQUEST: EoeType.GET_FILTER_RESPONSE,
}


class EoeServer:
    """The EoE protocol of a slave.

    Args:
        sizes: Of the slave's mailboxes.
        settings: What it starts with.
        accept: Judges new settings; anything but OK refuses them.
        receive_frame: Called with each Ethernet frame from the master; returns frames to send back.
    """

    def __init__(
        self,
        sizes: MailboxSizes,
        *,
        settings: IpSettings | None = None,
        accept: Callable[[IpSettings], EoeResult] | None = None,
        receive_frame: Callable[[bytes], list[bytes]] | None = None,
    ) -> None:
        self.settings = settings or IpSettings()
        self.assembler = Assembler()
        self.dropped = 0
        """Frames lost because the master did not fetch those before, or too long to be sent."""
        self._sizes = sizes
        self._accept = accept
        self._receive_frame = receive_frame
        self._pending: deque[bytes] = deque()
        self._frame_number = 0

    def reset(self) -> None:
        """Forget the frame that is not complete, and what waits to be sent."""
        self.assembler.reset()
        self._pending.clear()

    def receive_message(self, data: bytes, now_ns: int) -> list[bytes]:
        """Act on a message behind its mailbox header and return the answer, if it has one."""
        del now_ns
        header, _, body = readable(decode_message, data)
        if header.type is EoeType.FRAGMENT:
            readable(self._take_fragment, data)
            return []
        if header.type not in _RESPONSE:
            refuse(MailboxError.SERVICE_NOT_SUPPORTED, f"type {header.type.name}")
        return [self._answer(header, bytes(body))]

    def messages_to_send(self, now_ns: int) -> list[bytes]:
        """Take the next fragment of the frames that wait."""
        del now_ns
        return [self._pending.popleft()] if self._pending else []

    def send_frame(self, frame: bytes) -> None:
        """Send an Ethernet frame to the master; raise CodecError if it is none."""
        room = self._sizes.to_master - DATA_OVERHEAD
        fragments = list(iter_fragments(frame, self._frame_number, room))
        if len(self._pending) + len(fragments) > MAX_PENDING:
            self.dropped += 1
            return
        self._frame_number = (self._frame_number + 1) % 16
        self._pending += fragments

    def _take_fragment(self, data: bytes) -> None:
        frame = self.assembler.receive(data)
        if frame is None or self._receive_frame is None:
            return
        for answer in self._receive_frame(frame):
            try:
                self.send_frame(answer)
            except CodecError:
                self.dropped += 1

    def _answer(self, header: EoeHeader, body: bytes) -> bytes:
        answer = _RESPONSE[header.type]
        port = header.port
        if header.type is EoeType.SET_IP_REQUEST:
            return encode_message(answer, result=self._set(body), port=port)
        if header.type is EoeType.GET_IP_REQUEST:
            return encode_message(answer, self.settings.encode(), port=port)
        return encode_message(answer, result=EoeResult.NO_FILTER, port=port)

    def _set(self, body: bytes) -> EoeResult:
        try:
            new = IpSettings.decode(body)
        except CodecError:
            return EoeResult.UNSPECIFIED
        result = EoeResult.OK if self._accept is None else self._accept(new)
        if result is EoeResult.OK:
            parts = msgspec.structs.asdict(new).items()
            given = {name: value for name, value in parts if value is not None}
            self.settings = msgspec.structs.replace(self.settings, **given)
        return result
