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
"""Longest Ethernet frame in bytes: with a VLAN tag, without check sequence, rounded up."""
_TIME_SIZE = 4
_WORDS = EoeHeader.SIZE + FragmentWord.SIZE


def iter_fragments(frame: bytes, number: int, data_size: int, *, port: int = 0) -> Iterator[bytes]:
    """Yield the EoE fragments of *frame*, each with at most *data_size* bytes of it.

    Args:
        frame: An Ethernet frame without check sequence.
        number: Frame number from 0 to 15, incremented for each frame.
        data_size: Bytes of a message after the two EoE words; at least 32, unless all fits in one.
        port: Port of the slave; 0 for any.

    Raises:
        CodecError: the frame is too long, or its fragments do not fit.
    """
    if not 0 < len(frame) <= MAX_FRAME:
        raise CodecError(f"a frame of {len(frame)} bytes, expected 1 to {MAX_FRAME}",
                         layout="EoeHeader")  # fmt: skip
    step = data_size if data_size >= len(frame) else data_size // FRAGMENT_UNIT * FRAGMENT_UNIT
    if not step:
        raise CodecError(
            f"fragments of {data_size} bytes, expected at least 32", layout="EoeHeader"
        )
    units = (len(frame) + FRAGMENT_UNIT - 1) // FRAGMENT_UNIT
    for fragment, start in enumerate(range(0, len(frame), step)):
        piece = frame[start : start + step]
        last = start + step >= len(frame)
        # Fragment 0 has the size of the whole frame in place of its offset, in units of 32 bytes.
        offset = start // FRAGMENT_UNIT if fragment else units
        word = FragmentWord(fragment, offset, number)
        yield EoeHeader(EoeType.FRAGMENT, port, last).encode() + word.encode() + piece


class FrameAssembler:
    """Reassembly of Ethernet frames from fragments, one frame at a time.

    Attributes:
        dropped: Number of frames with missing or inconsistent fragments.
    """

    def __init__(self) -> None:
        self.dropped = 0
        self._content: bytearray | None = None
        self._number = 0
        self._next = 0
        self._dropped_number = -1

    def reset(self) -> None:
        """Discard the incomplete frame."""
        self._content = None

    def receive(self, message: bytes) -> bytes | None:
        """Add a message of type FRAGMENT; return the completed frame, or None.

        Raises:
            CodecError: the message is too short.
        """
        header = EoeHeader.decode(message)
        word = FragmentWord.decode(message, EoeHeader.SIZE)
        data = message[_WORDS:]
        if header.last and header.time_appended:
            if len(data) < _TIME_SIZE:
                raise MalformedError("time stamp announced, but missing", layout="EoeHeader")
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
        # The size in fragment 0 is not compared: it is rounded up to 32 bytes.
        is_in_place = word.fragment == 0 or word.offset * FRAGMENT_UNIT == len(content)
        return is_in_place and len(content) + len(data) <= MAX_FRAME

    def _drop(self, number: int) -> None:
        self._content = None
        # A frame counts once, however many of its fragments follow.
        self.dropped += number != self._dropped_number
        self._dropped_number = number


def set_ip(settings: IpSettings, *, port: int = 0) -> Conversation[None]:
    """Write a slave's Ethernet settings; fields that are None stay unchanged.

    Raises:
        EoeError: the slave refuses the settings.
        MailboxProtocolError: the answer is invalid.
        CodecError: the name is too long.
    """
    request = encode_message(EoeType.SET_IP_REQUEST, settings.encode(), port=port)
    yield from _exchange("EoE set IP", request)


def get_ip(*, port: int = 0) -> Conversation[IpSettings]:
    """Read a slave's Ethernet settings; raises as set_ip() does."""
    request = encode_message(EoeType.GET_IP_REQUEST, port=port)
    body = yield from _exchange("EoE get IP", request)
    with reading("EoE get IP"):
        return IpSettings.decode(body)


def _exchange(what: str, request: bytes) -> Conversation[bytes]:
    message = yield MailboxRequest(MailboxType.EOE, request)
    with reading(what):
        _, result, body = decode_message(message.data)
    if result != EoeResult.OK:
        raise EoeError(f"{what}: {name_of(result)} (0x{result:04X})", result=result)
    return bytes(body)


MAX_PENDING = 64
"""Limit for queued fragments; a frame that exceeds it is dropped and counted."""
_RESPONSE = {
    EoeType.SET_IP_REQUEST: EoeType.SET_IP_RESPONSE,
    EoeType.GET_IP_REQUEST: EoeType.GET_IP_RESPONSE,
    EoeType.SET_FILTER_REQUEST: EoeType.SET_FILTER_RESPONSE,
    EoeType.GET_FILTER_REQUEST: EoeType.GET_FILTER_RESPONSE,
}


class EoeServer:
    """EoE protocol of a slave.

    Args:
        sizes: Sizes of the slave's mailboxes.
        settings: Initial IP settings.
        accept: Checks new settings; any result but OK refuses them.
        receive_frame: Called with each Ethernet frame from the master; returns frames to send back.
        announce: Called after new settings; returns frames to send.
    """

    def __init__(
        self,
        sizes: MailboxSizes,
        *,
        settings: IpSettings | None = None,
        accept: Callable[[IpSettings], EoeResult] | None = None,
        receive_frame: Callable[[bytes], list[bytes]] | None = None,
        announce: Callable[[], list[bytes]] | None = None,
    ) -> None:
        self.settings = settings or IpSettings()
        self.assembler = FrameAssembler()
        self.dropped = 0
        """Number of frames lost because the queue was full or the frame too long."""
        self._sizes = sizes
        self._accept = accept
        self._receive_frame = receive_frame
        self._announce = announce
        self._pending: deque[bytes] = deque()
        self._frame_number = 0

    def reset(self) -> None:
        """Discard the incomplete frame and the queued fragments."""
        self.assembler.reset()
        self._pending.clear()

    def receive_message(self, data: bytes, now_ns: int) -> list[bytes]:
        """Handle a message (without mailbox header) and return its answers."""
        del now_ns
        header, _, body = decode_or_error(decode_message, data)
        if header.type is EoeType.FRAGMENT:
            decode_or_error(self._receive_fragment, data)
            return []
        if header.type not in _RESPONSE:
            raise_mailbox_error(MailboxError.SERVICE_NOT_SUPPORTED, f"type {header.type.name}")
        return [self._answer(header, bytes(body))]

    def messages_to_send(self, now_ns: int) -> list[bytes]:
        """Return and remove the next queued fragment."""
        del now_ns
        return [self._pending.popleft()] if self._pending else []

    def send_frame(self, frame: bytes) -> None:
        """Queue an Ethernet frame for the master; raise CodecError if it is invalid."""
        data_size = self._sizes.to_master - DATA_OVERHEAD
        fragments = list(iter_fragments(frame, self._frame_number, data_size))
        if len(self._pending) + len(fragments) > MAX_PENDING:
            self.dropped += 1
            return
        self._frame_number = (self._frame_number + 1) % 16
        self._pending += fragments

    def _receive_fragment(self, data: bytes) -> None:
        frame = self.assembler.receive(data)
        if frame is None or self._receive_frame is None:
            return
        self._send_frames(self._receive_frame(frame))

    def _send_frames(self, frames: list[bytes]) -> None:
        for frame in frames:
            try:
                self.send_frame(frame)
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
            if self._announce is not None:
                self._send_frames(self._announce())
        return result
