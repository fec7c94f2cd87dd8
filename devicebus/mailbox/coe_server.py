"""CoE of a slave: SDO transfers and SDO information out of an object dictionary (ETG.1000.6).

The SDO server has one transfer at a time: a new one ends the one before.  The client asks for each
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
            raise SdoAbortError(AbortCode.TOO_LONG, *where, f"more than {self.size} bytes")
        if head.last and len(self.data) < self.size:
            raise SdoAbortError(AbortCode.TOO_SHORT, *where, f"less than {self.size} bytes")
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
        raise SdoAbortError(AbortCode.LENGTH, *where, f"{len(data)} bytes of {head.value}")
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
            raise_mailbox_error(
                MailboxError.SIZE_TOO_SHORT, f"an SDO of {len(body)} bytes, expected 8"
            )
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
        # The client did not say how many of the four bytes count, so the entry does.
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


_OVERHEAD = 12
"""Bytes of a mailbox in front of the body: headers of mailbox, CoE and SDO information."""


class SdoInfoServer:
    """The SDO information service of a slave."""

    def __init__(self, dictionary: ObjectDictionary, sizes: MailboxSizes) -> None:
        self._dictionary = dictionary
        self._sizes = sizes

    def receive_request(self, body: bytes) -> list[bytes]:
        """Answer a request behind its CoE header with as many fragments as it takes."""
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
        room = (self._sizes.to_master - _OVERHEAD) & ~1
        pieces = [answer[at : at + room] for at in range(0, len(answer), room)]
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
            asked = EntryRequest.decode(body)
            described = info.entry_description(
                self._dictionary, asked.index, asked.subindex, asked.value_info
            )
            return SdoInfoOpcode.ENTRY_RESPONSE, described
        raise SdoAbortError(AbortCode.COMMAND, 0, 0, f"opcode {opcode.name} is no request")


MAX_PENDING = 16
"""Emergencies and PDOs that wait for the master; what comes on top is dropped and counted."""

_ANSWERED_BY = {
    CoeService.TX_PDO_REMOTE_REQUEST: CoeService.TX_PDO,
    CoeService.RX_PDO_REMOTE_REQUEST: CoeService.RX_PDO,
}


class CoeServer:
    """The CoE protocol of a slave.

    Args:
        dictionary: What SDOs read and write, and SDO information describes.
        state: Says in which state the slave is now.
        sizes: Of the slave's mailboxes.
        read_pdo: Returns the TxPDO or RxPDO of a number (told apart by the service TX_PDO or
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
        """Emergencies and PDOs lost because the master did not fetch those before."""

    def reset(self) -> None:
        """Forget the transfer under way and what waits to be sent."""
        self._sdo.reset()
        self._pending.clear()

    def receive_message(self, data: bytes, now_ns: int) -> list[bytes]:
        """Act on a message behind its mailbox header and return the answers."""
        del now_ns
        header = decode_or_error(CoeHeader.decode, data)
        body = data[CoeHeader.SIZE :]
        if header.service is CoeService.SDO_REQUEST:
            return self._sdo.receive_request(body)
        if header.service is CoeService.SDO_INFORMATION:
            return self._info.receive_request(body)
        return self._answer_pdo(header, body)

    def messages_to_send(self, now_ns: int) -> list[bytes]:
        """Take emergencies and PDOs that are due."""
        del now_ns
        messages = list(self._pending)
        self._pending.clear()
        return messages

    def send_emergency(self, error_code: int, register: int = 0, data: bytes = b"") -> None:
        """Report an error, or with code 0 its end; *data* is up to five bytes of the vendor."""
        emergency = Emergency(error_code, register, data.ljust(5, b"\0"))
        self._push(encode_message(CoeService.EMERGENCY, emergency.encode()))

    def send_tx_pdo(self, number: int, data: bytes) -> None:
        """Send a TxPDO through the mailbox unasked."""
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
