"""EoE for both sides: Ethernet frames in fragments, and IP settings (ETG.1000.6)."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator

import msgspec

from devicebus.errors import EoeError
from devicebus.mailbox.conversation import Conversation, MailboxRequest, reading
from devicebus.mailbox.protocol import MailboxSizes, decode_or_error, raise_mailbox_error
from eap.codec.eoe import (
    DATA_OVERHEAD,
    FRAGMENT_UNIT,
    EoeHeader,
    EoeResult,
    EoeType,
    FragmentWord,
    IpSettings,
    decode_message,
    encode_message,
    name_of,
)
from eap.codec.mailbox import MailboxError, MailboxType
from eap.errors import CodecError, MalformedError

MAX_FRAME = 1522
"""Bytes of the longest Ethernet frame, with a VLAN tag and without check sequence, rounded up."""
_TIME_SIZE = 4
_WORDS = EoeHeader.SIZE + FragmentWord.SIZE


def iter_fragments(frame: bytes, number: int, room: int, *, port: int = 0) -> Iterator[bytes]:
    """Yield the messages that carry *frame*, each with at most *room* bytes of it.

    Args:
        frame: An Ethernet frame without check sequence.
        number: From 0 to 15, another one for each frame.
        room: Bytes of a message behind the two words of EoE; at least 32, unless all fits in one.
        port: Of the slave; 0 for any.

    Raises:
        CodecError: the frame is too long, or its fragments do not fit.
    """
    if not 0 < len(frame) <= MAX_FRAME:
        raise CodecError(f"a frame of {len(frame)} bytes, expected 1 to {MAX_FRAME}",
                         layout="EoeHeader")  # fmt: skip
    step = room if room >= len(frame) else room // FRAGMENT_UNIT * FRAGMENT_UNIT
    if not step:
        raise CodecError(f"room for {room} bytes, expected 32", layout="EoeHeader")
    units = (len(frame) + FRAGMENT_UNIT - 1) // FRAGMENT_UNIT
    for fragment, start in enumerate(range(0, len(frame), step)):
        piece = frame[start : start + step]
        last = start + step >= len(frame)
        offset = start // FRAGMENT_UNIT if fragment else units
        word = FragmentWord(fragment, offset, number)
        yield EoeHeader(EoeType.FRAGMENT, port, last).encode() + word.encode() + piece


class FrameAssembler:
    """Puts fragments together again, one frame at a time.

    Attributes:
        dropped: Frames of which fragments were missing or did not fit together.
    """

    def __init__(self) -> None:
        self.dropped = 0
        self._content: bytearray | None = None
        self._number = 0
        self._next = 0
        self._dropped_number = -1

    def reset(self) -> None:
        """Forget the frame that is not complete."""
        self._content = None

    def receive(self, message: bytes) -> bytes | None:
        """Take a message of type FRAGMENT; return the frame that it completes, if it does.

        Raises:
            CodecError: the message is too short.
        """
        header = EoeHeader.decode(message)
        word = FragmentWord.decode(message, EoeHeader.SIZE)
        data = message[_WORDS:]
        if header.last and header.time_appended:
            if len(data) < _TIME_SIZE:
                raise MalformedError("no room for the time that is appended", layout="EoeHeader")
            data = data[:-_TIME_SIZE]
        if word.fragment == 0:
            if self._content is not None:
                self._drop(self._number)
            self._content = bytearray()
            self._number, self._next, self._dropped_number = word.frame, 0, -1
        if self._content is not None and not self._fits(word, data):
            self._drop(self._number)
        if self._content is None:
            self._drop(word.frame)
            return None
        self._content += data
        self._next += 1
        if not header.last:
            return None
        frame, self._content = bytes(self._content), None
        return frame

    def _fits(self, word: FragmentWord, data: bytes) -> bool:
        content = self._content or b""
        if (word.frame, word.fragment) != (self._number, self._next):
            return False
        is_in_place = word.fragment == 0 or word.offset * FRAGMENT_UNIT == len(content)
        return is_in_place and len(content) + len(data) <= MAX_FRAME

    def _drop(self, number: int) -> None:
        self._content = None
        self.dropped += number != self._dropped_number
        self._dropped_number = number


def set_ip(settings: IpSettings, *, port: int = 0) -> Conversation[None]:
    """Give a slave Ethernet settings; those that are None stay as they are.

    Raises:
        EoeError: the slave refuses.
        MailboxProtocolError: its answer is no answer.
        CodecError: the name is too long.
    """
    request = encode_message(EoeType.SET_IP_REQUEST, settings.encode(), port=port)
    yield from _ask("EoE set IP", request)


def get_ip(*, port: int = 0) -> Conversation[IpSettings]:
    """Read a slave's Ethernet settings; raises as set_ip() does."""
    request = encode_message(EoeType.GET_IP_REQUEST, port=port)
    body = yield from _ask("EoE get IP", request)
    with reading("EoE get IP"):
        return IpSettings.decode(body)


def _ask(what: str, request: bytes) -> Conversation[bytes]:
    message = yield MailboxRequest(MailboxType.EOE, request)
    with reading(what):
        _, result, body = decode_message(message.data)
    if result != EoeResult.OK:
        raise EoeError(f"{what}: {name_of(result)} (0x{result:04X})", result=result)
    return bytes(body)


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
        self.assembler = FrameAssembler()
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
        header, _, body = decode_or_error(decode_message, data)
        if header.type is EoeType.FRAGMENT:
            decode_or_error(self._take_fragment, data)
            return []
        if header.type not in _RESPONSE:
            raise_mailbox_error(MailboxError.SERVICE_NOT_SUPPORTED, f"type {header.type.name}")
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
