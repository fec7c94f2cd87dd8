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
_OF_SEGMENTS = (SdoRequest.DOWNLOAD_SEGMENT.value, SdoRequest.UPLOAD_SEGMENT.value)
_UPLOADED, _RESPONSE = SdoResponse.UPLOAD, CoeService.SDO_RESPONSE


class _Transfer:
    """A segmented transfer that is under way."""

    __slots__ = ("complete", "content", "index", "is_upload", "size", "subindex", "toggle")

    def __init__(self, head: SdoHeader, content: bytearray, size: int, *, is_upload: bool) -> None:
        self.index = head.index
        self.subindex = head.subindex
        self.complete = bool(head.complete)
        self.is_upload = is_upload
        self.content = content
        """What was received so far, or has still to be sent."""
        self.size = size
        self.toggle = 0


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
        self._transfer: _Transfer | None = None

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
        if specifier in _OF_SEGMENTS:
            answer = self._continue(SdoRequest(specifier), body)
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
            rest = bytearray(data[room:])
            self._transfer = _Transfer(head, rest, len(data), is_upload=True)
        return encode_initiate(_UPLOADED, index, subindex, data, complete=complete, room=room)

    def _start_download(self, head: SdoHeader, rest: bytes) -> bytes:
        where = (head.index, head.subindex)
        complete = bool(head.complete)
        data = self._expedited(head) if head.expedited else rest
        size = len(data) if head.expedited else head.value
        if not head.expedited and not head.has_size:
            raise SdoAbortError(AbortCode.COMMAND, *where, "neither expedited nor with a size")
        if len(data) > size:
            raise SdoAbortError(AbortCode.LENGTH, *where, f"{len(data)} octets of {size}")
        self._dictionary.check_download(*where, size, self._state(), complete=complete)
        if len(data) == size:
            self._store(head.index, head.subindex, data, complete=complete)
        else:
            self._transfer = _Transfer(head, bytearray(data), size, is_upload=False)
        return encode_plain(SdoResponse.DOWNLOAD, *where, complete=complete)

    def _expedited(self, head: SdoHeader) -> bytes:
        data = head.data
        if head.has_size or head.complete:
            return data
        # The client did not say how many of the four octets count, so the entry does.
        return data[: self._dictionary.entry(head.index, head.subindex).kind.size]

    def _continue(self, request: SdoRequest, body: bytes) -> bytes:
        transfer = self._transfer
        is_upload = request is SdoRequest.UPLOAD_SEGMENT
        if transfer is None or transfer.is_upload is not is_upload:
            self._transfer = None
            return encode_abort(0, 0, AbortCode.COMMAND)
        if SdoSegmentHeader.decode(body).toggle != transfer.toggle:
            self._transfer = None
            return encode_abort(transfer.index, transfer.subindex, AbortCode.TOGGLE)
        try:
            answer = self._send_segment(transfer) if is_upload else self._take(transfer, body)
        except SdoAbortError as exc:
            self._transfer = None
            return encode_abort(transfer.index, transfer.subindex, exc.code)
        transfer.toggle ^= 1
        return encode_message(_RESPONSE, answer)

    def _send_segment(self, transfer: _Transfer) -> bytes:
        room = self._sizes.to_master - SEGMENT_OVERHEAD
        data = bytes(transfer.content[:room])
        del transfer.content[:room]
        last = not transfer.content
        if last:
            self._transfer = None
        return encode_segment(SdoResponse.UPLOAD_SEGMENT, data, toggle=transfer.toggle, last=last)

    def _take(self, transfer: _Transfer, body: bytes) -> bytes:
        head, data = decode_segment(body)
        where = (transfer.index, transfer.subindex)
        transfer.content += data
        if len(transfer.content) > transfer.size:
            raise SdoAbortError(AbortCode.TOO_LONG, *where, f"more than {transfer.size} octets")
        if head.last:
            if len(transfer.content) < transfer.size:
                raise SdoAbortError(AbortCode.TOO_SHORT, *where, f"less than {transfer.size}")
            self._store(*where, bytes(transfer.content), complete=transfer.complete)
            self._transfer = None
        return encode_segment_answer(SdoResponse.DOWNLOAD_SEGMENT, toggle=transfer.toggle)

    def _store(self, index: int, subindex: int, data: bytes, *, complete: bool) -> None:
        dictionary = self._dictionary
        write = dictionary.download_complete if complete else dictionary.download
        write(index, subindex, data, self._state())
