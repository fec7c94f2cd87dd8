"""Serves SDO uploads and downloads out of an object dictionary (ETG.1000.6).

One transfer at a time, as the standard has it: whatever starts a new one ends the one before.  A
client asks for each segment, so nothing happens here without a request.
"""

from __future__ import annotations

from collections.abc import Callable

from devicebus.mailbox.protocol import MailboxSizes, refuse
from eap.codec.coe import CoeService, encode_message
from eap.codec.mailbox import MailboxError
from eap.codec.sdo import (
    EXPEDITED_SIZE,
    INITIATE_OVERHEAD,
    SEGMENT_OVERHEAD,
    SdoHeader,
    SdoRequest,
    SdoResponse,
    SdoSegmentHeader,
    decode_segment,
    encode_abort,
    encode_initiate,
    encode_plain,
    encode_segment,
    encode_segment_answer,
)
from eap.od.abort import AbortCode, SdoAbortError
from eap.od.dictionary import ObjectDictionary
from eap.od.model import OdState

# Plain numbers, because members of enums are slow to reach.
_UPLOAD, _DOWNLOAD, _ABORT = (SdoRequest[name].value for name in ("UPLOAD", "DOWNLOAD", "ABORT"))
SEGMENTS = {
    SdoRequest.DOWNLOAD_SEGMENT.value: _DOWNLOAD,
    SdoRequest.UPLOAD_SEGMENT.value: _UPLOAD,
}
"""Command specifiers of segments, and of the first messages of their transfers."""
_UPLOADED, _RESPONSE = SdoResponse.UPLOAD, CoeService.SDO_RESPONSE


class SegmentedTransfer:
    """SDO in segments, as its server sees it.

    Args:
        head: Of its first message.
        size: Bytes in all.
        data: What has come, of a download; what has still to go, of an upload.

    Attributes:
        toggle: Toggle bit of the next segment.
    """

    __slots__ = ("data", "head", "size", "toggle")

    def __init__(self, head: SdoHeader, size: int, data: bytes = b"") -> None:
        self.head = head
        self.size = size
        self.data = bytearray(data)
        self.toggle = 0

    def take(self, segment: bytes) -> bool:
        """Add a segment of a download; return true for the last one.

        Raises:
            SdoAbortError: it does not end where the first message said.
        """
        head, data = decode_segment(segment)
        self.data += data
        where = self.head.index, self.head.subindex
        if len(self.data) > self.size:
            raise SdoAbortError(AbortCode.TOO_LONG, *where, f"more than {self.size} octets")
        if head.last and len(self.data) < self.size:
            raise SdoAbortError(AbortCode.TOO_SHORT, *where, f"less than {self.size} octets")
        return bool(head.last)


def transfer_of(segment: bytes, running: SegmentedTransfer | None) -> SegmentedTransfer:
    """Return the running transfer, which a segment goes on with.

    Raises:
        SdoAbortError: it belongs to no transfer under way, or is not its next one.
    """
    head = SdoSegmentHeader.decode(segment)
    if running is None or running.head.specifier != SEGMENTS.get(head.specifier):
        raise SdoAbortError(AbortCode.COMMAND, 0, 0, "no transfer of this kind is under way")
    if head.toggle != running.toggle:
        raise SdoAbortError(AbortCode.TOGGLE, running.head.index, running.head.subindex)
    return running


def size_of_download(head: SdoHeader, data: bytes) -> int:
    """Return the size that the first message of a normal download names, *data* behind its head.

    Raises:
        SdoAbortError: it names none, or less than it brings.
    """
    where = head.index, head.subindex
    if not head.has_size:
        raise SdoAbortError(AbortCode.COMMAND, *where, "neither expedited nor with a size")
    if len(data) > head.value:
        raise SdoAbortError(AbortCode.LENGTH, *where, f"{len(data)} octets of {head.value}")
    return int(head.value)


class SdoServer:
    """The SDO service of a slave.

    Args:
        dictionary: What is read and written.
        state: Says in which state the slave is now.
        sizes: Of the slave's mailboxes.
    """

    def __init__(
        self, dictionary: ObjectDictionary, state: Callable[[], OdState], sizes: MailboxSizes
    ) -> None:
        self._dictionary = dictionary
        self._state = state
        self._sizes = sizes
        self._transfer: SegmentedTransfer | None = None

    def reset(self) -> None:
        """Forget the transfer under way."""
        self._transfer = None

    def receive_request(self, body: bytes) -> list[bytes]:
        """Act on an SDO request behind its CoE header; return the answer, if it has one."""
        if len(body) < SdoHeader.SIZE:
            refuse(MailboxError.SIZE_TOO_SHORT, f"an SDO of {len(body)} octets, expected 8")
        specifier = body[0] >> 5
        if specifier == _ABORT:
            self._transfer = None
            return []
        if specifier in SEGMENTS:
            answer = self._continue(body)
        else:
            answer = self._start(SdoHeader.decode(body), body[SdoHeader.SIZE :])
        return [answer]

    def _start(self, head: SdoHeader, rest: bytes) -> bytes:
        self._transfer = None
        try:
            if head.specifier == _UPLOAD:
                body = self._start_upload(head)
            elif head.specifier == _DOWNLOAD:
                body = self._start_download(head, rest)
            else:
                return encode_abort(head.index, head.subindex, AbortCode.COMMAND)
        except SdoAbortError as exc:
            return encode_abort(head.index, head.subindex, exc.code)
        return encode_message(_RESPONSE, body)

    def _start_upload(self, head: SdoHeader) -> bytes:
        index, subindex, complete = head.index, head.subindex, bool(head.complete)
        read = self._dictionary.upload_complete if complete else self._dictionary.upload
        data = read(index, subindex, self._state())
        room = self._sizes.to_master - INITIATE_OVERHEAD
        if len(data) > max(room, EXPEDITED_SIZE):
            self._transfer = SegmentedTransfer(head, len(data), data[room:])
        return encode_initiate(_UPLOADED, index, subindex, data, complete=complete, room=room)

    def _start_download(self, head: SdoHeader, rest: bytes) -> bytes:
        where = (head.index, head.subindex)
        complete = bool(head.complete)
        data = self._expedited(head) if head.expedited else rest
        size = len(data) if head.expedited else size_of_download(head, data)
        self._dictionary.check_download(*where, size, self._state(), complete=complete)
        if len(data) == size:
            self._store(head.index, head.subindex, data, complete=complete)
        else:
            self._transfer = SegmentedTransfer(head, size, data)
        return encode_plain(SdoResponse.DOWNLOAD, *where, complete=complete)

    def _expedited(self, head: SdoHeader) -> bytes:
        data = head.data
        if head.has_size or head.complete:
            return data
        # The client did not say how many of the four octets count, so the entry does.
        return data[: self._dictionary.entry(head.index, head.subindex).kind.size]

    def _continue(self, segment: bytes) -> bytes:
        running, self._transfer = self._transfer, None
        try:
            transfer = transfer_of(segment, running)
        except SdoAbortError as exc:
            return encode_abort(exc.index, exc.subindex, exc.code)
        head = transfer.head
        try:
            is_upload = head.specifier == _UPLOAD
            answer = self._send_segment(transfer) if is_upload else self._take(transfer, segment)
        except SdoAbortError as exc:
            return encode_abort(head.index, head.subindex, exc.code)
        return encode_message(_RESPONSE, answer)

    def _send_segment(self, transfer: SegmentedTransfer) -> bytes:
        room = self._sizes.to_master - SEGMENT_OVERHEAD
        data, toggle = bytes(transfer.data[:room]), transfer.toggle
        del transfer.data[:room]
        last = not transfer.data
        self._go_on(transfer, last=last)
        return encode_segment(SdoResponse.UPLOAD_SEGMENT, data, toggle=toggle, last=last)

    def _take(self, transfer: SegmentedTransfer, segment: bytes) -> bytes:
        head, toggle = transfer.head, transfer.toggle
        last = transfer.take(segment)
        if last:
            complete = bool(head.complete)
            self._store(head.index, head.subindex, bytes(transfer.data), complete=complete)
        self._go_on(transfer, last=last)
        return encode_segment_answer(SdoResponse.DOWNLOAD_SEGMENT, toggle=toggle)

    def _go_on(self, transfer: SegmentedTransfer, *, last: bool) -> None:
        transfer.toggle ^= 1
        self._transfer = None if last else transfer

    def _store(self, index: int, subindex: int, data: bytes, *, complete: bool) -> None:
        dictionary = self._dictionary
        write = dictionary.download_complete if complete else dictionary.download
        write(index, subindex, data, self._state())
