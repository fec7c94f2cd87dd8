"""CoE of a slave: SDO transfers and SDO information out of an object dictionary (ETG.1000.6).

The SDO server has one transfer at a time: a new one ends the one before.  The client requests each
segment, so the server never sends unasked.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

from devicebus.mailbox.protocol import MailboxSizes, decode_or_error, raise_mailbox_error
from eap.codec.coe import (
    EXPEDITED_SIZE,
    INITIATE_OVERHEAD,
    SEGMENT_OVERHEAD,
    CoeHeader,
    CoeService,
    Emergency,
    EntryRequest,
    InfoError,
    ListRequest,
    ObjectRequest,
    SdoHeader,
    SdoInfoHeader,
    SdoInfoOpcode,
    SdoRequest,
    SdoResponse,
    SdoSegmentHeader,
    decode_segment,
    decode_upload,
    encode_abort,
    encode_initiate,
    encode_message,
    encode_plain,
    encode_segment,
    encode_segment_answer,
)
from eap.codec.mailbox import MailboxError
from eap.errors import CodecError, TruncatedError
from eap.od import info
from eap.od.abort import AbortCode, SdoAbortError
from eap.od.dictionary import ObjectDictionary
from eap.od.model import OdState

# Plain numbers, because members of enums are slow to reach.
_UPLOAD, _DOWNLOAD, _ABORT = (SdoRequest[name].value for name in ("UPLOAD", "DOWNLOAD", "ABORT"))
SEGMENTS = {
    SdoRequest.DOWNLOAD_SEGMENT.value: _DOWNLOAD,
    SdoRequest.UPLOAD_SEGMENT.value: _UPLOAD,
}
"""Command specifiers of segments, with those of the first message of their transfer."""
_UPLOADED, _RESPONSE = SdoResponse.UPLOAD, CoeService.SDO_RESPONSE
_SDO_REQUEST = CoeService.SDO_REQUEST.value


class SegmentedTransfer:
    """Server side of a segmented SDO transfer.

    Args:
        head: SDO header of the first message.
        size: Total size in bytes.
        data: Received data of a download; remaining data of an upload.

    Attributes:
        toggle: Toggle bit of the next segment.
    """

    __slots__ = ("data", "head", "size", "toggle")

    def __init__(self, head: SdoHeader, size: int, data: bytes = b"") -> None:
        self.head = head
        self.size = size
        self.data = bytearray(data)
        self.toggle = 0

    def add_segment(self, segment: bytes) -> bool:
        """Append a segment of a download; return true for the last segment.

        Raises:
            SdoAbortError: the total size is not that of the first message.
        """
        # The size of the first message counts; the unused count of a segment is only valid below
        # seven bytes, where the mailbox length is always 10.
        head, data = decode_segment(segment)
        self.data += data
        where = self.head.index, self.head.subindex
        if len(self.data) > self.size:
            raise SdoAbortError(AbortCode.TOO_LONG, *where, f"more than {self.size} bytes")
        if head.last and len(self.data) < self.size:
            raise SdoAbortError(AbortCode.TOO_SHORT, *where, f"less than {self.size} bytes")
        return bool(head.last)


def transfer_of(segment: bytes, running: SegmentedTransfer | None) -> SegmentedTransfer:
    """Return the running transfer that *segment* continues.

    Raises:
        SdoAbortError: no such transfer is under way, or the toggle bit is wrong.
    """
    head = SdoSegmentHeader.decode(segment)
    if running is None or running.head.specifier != SEGMENTS.get(head.specifier):
        raise SdoAbortError(AbortCode.COMMAND, 0, 0, "no transfer of this kind is under way")
    # The toggle bit starts at 0 and alternates; a repeated bit aborts with 0x05030000.
    if head.toggle != running.toggle:
        raise SdoAbortError(AbortCode.TOGGLE, running.head.index, running.head.subindex)
    return running


def size_of_download(head: SdoHeader, data: bytes) -> int:
    """Return the total size of a normal download from its first message's head and *data*.

    Raises:
        SdoAbortError: the message has no size, or more data than its size.
    """
    where = head.index, head.subindex
    if not head.has_size:
        raise SdoAbortError(AbortCode.COMMAND, *where, "neither expedited nor with a size")
    if len(data) > head.value:
        raise SdoAbortError(AbortCode.LENGTH, *where, f"{len(data)} bytes of {head.value}")
    return int(head.value)


class SdoServer:
    """SDO service of a slave.

    Args:
        dictionary: Objects to read and write.
        state: Returns the present state of the slave.
        sizes: Sizes of the slave's mailboxes.
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
        """Handle an SDO request (without CoE header) and return its answers."""
        if len(body) < SdoHeader.SIZE:
            raise_mailbox_error(
                MailboxError.SIZE_TOO_SHORT, f"an SDO of {len(body)} bytes, expected 8"
            )
        specifier = body[0] >> 5
        # An abort ends the transfer and has no answer of its own.
        if specifier == _ABORT:
            self._transfer = None
            return []
        if specifier in SEGMENTS:
            answer = self._continue(body)
        elif specifier == _UPLOAD:
            answer = self._upload(body)
        else:
            answer = self._start(SdoHeader.decode(body), body[SdoHeader.SIZE :])
        return [answer]

    def _start(self, head: SdoHeader, rest: bytes) -> bytes:
        self._transfer = None
        try:
            if head.specifier != _DOWNLOAD:
                return encode_abort(head.index, head.subindex, AbortCode.COMMAND)
            body = self._start_download(head, rest)
        except SdoAbortError as exc:
            return encode_abort(head.index, head.subindex, exc.code)
        return encode_message(_RESPONSE, body)

    def _upload(self, body: bytes) -> bytes:
        self._transfer = None
        index, subindex, complete = decode_upload(body)
        read = self._dictionary.upload_complete if complete else self._dictionary.upload
        try:
            data = read(index, subindex, self._state())
        except SdoAbortError as exc:
            return encode_abort(index, subindex, exc.code)
        data_size = self._sizes.to_master - INITIATE_OVERHEAD
        # Up to four bytes go into the header (expedited) and fit every mailbox.
        if len(data) > data_size and len(data) > EXPEDITED_SIZE:
            self._transfer = SegmentedTransfer(SdoHeader.decode(body), len(data), data[data_size:])
        answer = encode_initiate(
            _UPLOADED, index, subindex, data, complete=complete, max_size=data_size
        )
        return encode_message(_RESPONSE, answer)

    def _start_download(self, head: SdoHeader, rest: bytes) -> bytes:
        where = (head.index, head.subindex)
        complete = bool(head.complete)
        data = self._expedited(head) if head.expedited else rest
        size = len(data) if head.expedited else size_of_download(head, data)
        # Rights and size are checked before the first segment: a refusal after the last one would
        # cost the client the whole transfer.
        self._dictionary.check_download(*where, size, self._state(), complete=complete)
        if len(data) == size:
            self._store(head.index, head.subindex, data, complete=complete)
        else:
            self._transfer = SegmentedTransfer(head, size, data)
        return encode_plain(SdoResponse.DOWNLOAD, *where, complete=complete)

    def _expedited(self, head: SdoHeader) -> bytes:
        data = head.data
        # Complete access has no single entry that tells a size: all four bytes count.
        if head.has_size or head.complete:
            return data
        # The client did not say how many of the four bytes count, so the entry does.
        return data[: self._dictionary.entry(head.index, head.subindex).kind.size]

    def _continue(self, segment: bytes) -> bytes:
        # Any error ends the transfer; only a good segment keeps it.
        running, self._transfer = self._transfer, None
        try:
            transfer = transfer_of(segment, running)
        except SdoAbortError as exc:
            return encode_abort(exc.index, exc.subindex, exc.code)
        head = transfer.head
        try:
            is_upload = head.specifier == _UPLOAD
            answer = (
                self._send_segment(transfer)
                if is_upload
                else self._receive_segment(transfer, segment)
            )
        except SdoAbortError as exc:
            return encode_abort(head.index, head.subindex, exc.code)
        return encode_message(_RESPONSE, answer)

    def _send_segment(self, transfer: SegmentedTransfer) -> bytes:
        data_size = self._sizes.to_master - SEGMENT_OVERHEAD
        data, toggle = bytes(transfer.data[:data_size]), transfer.toggle
        del transfer.data[:data_size]
        last = not transfer.data
        self._keep_until(transfer, last=last)
        return encode_segment(SdoResponse.UPLOAD_SEGMENT, data, toggle=toggle, last=last)

    def _receive_segment(self, transfer: SegmentedTransfer, segment: bytes) -> bytes:
        head, toggle = transfer.head, transfer.toggle
        last = transfer.add_segment(segment)
        if last:
            complete = bool(head.complete)
            self._store(head.index, head.subindex, bytes(transfer.data), complete=complete)
        self._keep_until(transfer, last=last)
        return encode_segment_answer(SdoResponse.DOWNLOAD_SEGMENT, toggle=toggle)

    def _keep_until(self, transfer: SegmentedTransfer, *, last: bool) -> None:
        transfer.toggle ^= 1
        self._transfer = None if last else transfer

    def _store(self, index: int, subindex: int, data: bytes, *, complete: bool) -> None:
        dictionary = self._dictionary
        write = dictionary.download_complete if complete else dictionary.download
        write(index, subindex, data, self._state())


# Bytes in front of the body: headers of mailbox, CoE and SDO information.
_OVERHEAD = 12


class SdoInfoServer:
    """SDO information service of a slave."""

    def __init__(self, dictionary: ObjectDictionary, sizes: MailboxSizes) -> None:
        self._dictionary = dictionary
        self._sizes = sizes

    def receive_request(self, body: bytes) -> list[bytes]:
        """Handle a request (without CoE header) and return the fragments of its answer."""
        try:
            header = SdoInfoHeader.decode(body)
            opcode, answer = self._answer(header.opcode, body[SdoInfoHeader.SIZE :])
        except SdoAbortError as exc:
            opcode, answer = SdoInfoOpcode.ERROR, InfoError(exc.code).encode()
        except TruncatedError:
            opcode, answer = SdoInfoOpcode.ERROR, InfoError(AbortCode.TOO_SHORT).encode()
        except CodecError:
            opcode, answer = SdoInfoOpcode.ERROR, InfoError(AbortCode.COMMAND).encode()
        # An index is never cut in two.
        data_size = (self._sizes.to_master - _OVERHEAD) & ~1
        pieces = [answer[at : at + data_size] for at in range(0, len(answer), data_size)]
        return [
            encode_message(
                CoeService.SDO_INFORMATION,
                SdoInfoHeader(opcode, bool(left), fragments_left=left).encode() + piece,
            )
            for left, piece in zip(range(len(pieces) - 1, -1, -1), pieces, strict=True)
        ]

    def _answer(self, opcode: SdoInfoOpcode, body: bytes) -> tuple[SdoInfoOpcode, bytes]:
        if opcode is SdoInfoOpcode.LIST_REQUEST:
            listed = info.object_list(self._dictionary, ListRequest.decode(body).list_type)
            return SdoInfoOpcode.LIST_RESPONSE, listed
        if opcode is SdoInfoOpcode.OBJECT_REQUEST:
            index = ObjectRequest.decode(body).index
            return SdoInfoOpcode.OBJECT_RESPONSE, info.object_description(self._dictionary, index)
        if opcode is SdoInfoOpcode.ENTRY_REQUEST:
            request = EntryRequest.decode(body)
            described = info.entry_description(
                self._dictionary, request.index, request.subindex, request.value_info
            )
            return SdoInfoOpcode.ENTRY_RESPONSE, described
        raise SdoAbortError(AbortCode.COMMAND, 0, 0, f"opcode {opcode.name} is no request")


MAX_PENDING = 16
"""Limit for queued emergencies and PDOs; further ones are dropped and counted."""

_ANSWERED_BY = {
    CoeService.TX_PDO_REMOTE_REQUEST: CoeService.TX_PDO,
    CoeService.RX_PDO_REMOTE_REQUEST: CoeService.RX_PDO,
}


class CoeServer:
    """CoE protocol of a slave.

    Args:
        dictionary: Objects of SDO and SDO information.
        state: Returns the present state of the slave.
        sizes: Sizes of the slave's mailboxes.
        read_pdo: Returns the TxPDO or RxPDO of a number (selected by the service TX_PDO or
            RX_PDO), None if there is none; without it the slave has no PDOs in its mailbox.
        write_pdo: Takes an RxPDO; returns whether there is one of this number.
    """

    def __init__(
        self,
        dictionary: ObjectDictionary,
        state: Callable[[], OdState],
        sizes: MailboxSizes,
        *,
        read_pdo: Callable[[CoeService, int], bytes | None] | None = None,
        write_pdo: Callable[[int, bytes], bool] | None = None,
    ) -> None:
        self._sdo = SdoServer(dictionary, state, sizes)
        self._info = SdoInfoServer(dictionary, sizes)
        self._read_pdo = read_pdo
        self._write_pdo = write_pdo
        self._pending: deque[bytes] = deque()
        self.dropped = 0
        """Number of emergencies and PDOs lost because the queue was full."""

    def reset(self) -> None:
        """Discard the transfer under way and the queued messages."""
        self._sdo.reset()
        self._pending.clear()

    def receive_message(self, data: bytes, now_ns: int) -> list[bytes]:
        """Handle a message (without mailbox header) and return its answers."""
        del now_ns
        body = data[CoeHeader.SIZE :]
        # The upper four bits are the service; an SDO has nothing else in this header.
        if len(data) >= CoeHeader.SIZE and data[1] >> 4 == _SDO_REQUEST:
            return self._sdo.receive_request(body)
        header = decode_or_error(CoeHeader.decode, data)
        if header.service is CoeService.SDO_INFORMATION:
            return self._info.receive_request(body)
        return self._answer_pdo(header, body)

    def messages_to_send(self, now_ns: int) -> list[bytes]:
        """Return and remove the queued emergencies and PDOs."""
        del now_ns
        messages = list(self._pending)
        self._pending.clear()
        return messages

    def send_emergency(self, error_code: int, register: int = 0, data: bytes = b"") -> None:
        """Queue an emergency; code 0 reports the end, *data* is up to five vendor bytes."""
        emergency = Emergency(error_code, register, data.ljust(5, b"\0"))
        self._push(encode_message(CoeService.EMERGENCY, emergency.encode()))

    def send_tx_pdo(self, number: int, data: bytes) -> None:
        """Queue an unsolicited TxPDO for the mailbox."""
        self._push(encode_message(CoeService.TX_PDO, data, number=number))

    def _push(self, message: bytes) -> None:
        if len(self._pending) < MAX_PENDING:
            self._pending.append(message)
        else:
            self.dropped += 1

    def _answer_pdo(self, header: CoeHeader, body: bytes) -> list[bytes]:
        answer = _ANSWERED_BY.get(header.service)
        if answer is not None and self._read_pdo is not None:
            data = self._read_pdo(answer, header.number)
            if data is not None:
                return [encode_message(answer, data, number=header.number)]
        write = self._write_pdo if header.service is CoeService.RX_PDO else None
        if write is not None and write(header.number, body):
            return []
        return raise_mailbox_error(
            MailboxError.SERVICE_NOT_SUPPORTED, f"{header.service.name}, number {header.number}"
        )
