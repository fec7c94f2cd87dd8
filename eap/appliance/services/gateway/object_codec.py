"""CoE in front of a slave: SDOs of a client as whole operations on the slave's objects.

An upload is read from the slave to its end at the slave's speed, and answered out of memory; its
first answer goes out as soon as the size and the first octets are there.  A download is collected,
and written when its last segment is there (ETG.1000.6 knows one SDO of a server at a time, so a
client that pauses in the middle of one would keep the slave from all others).
"""

from __future__ import annotations

from devicebus.mailbox.protocol import MailboxSizes
from eap.appliance.services.slaves.access import SlaveAccess
from eap.appliance.services.slaves.object_stream import ObjectStream
from eap.codec.coe import CoeHeader, CoeService, encode_message
from eap.codec.mailbox import MailboxType
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
from eap.codec.sdoinfo import InfoError, SdoInfoHeader, SdoInfoOpcode
from eap.errors import TruncatedError
from eap.gateway.error_table import Cause
from eap.gateway.refusal import GatewayError
from eap.gateway.request_tracker import MemoryShare
from eap.od.abort import AbortCode, SdoAbortError

_LAST = 0x01
_UNANSWERED = frozenset((CoeService.TX_PDO, CoeService.RX_PDO, CoeService.EMERGENCY))
_SEGMENTS = frozenset((SdoRequest.DOWNLOAD_SEGMENT, SdoRequest.UPLOAD_SEGMENT))
_QUERIES = frozenset(
    (SdoInfoOpcode.LIST_REQUEST, SdoInfoOpcode.OBJECT_REQUEST, SdoInfoOpcode.ENTRY_REQUEST)
)


class _Upload:
    """An object on its way to the client; *toggle* is the toggle bit of the next segment."""

    def __init__(self, head: SdoHeader, stream: ObjectStream) -> None:
        self.head = head
        self.stream = stream
        self.toggle = 0


class _Download:
    """An object on its way from the client; the slave gets it when it is whole."""

    def __init__(self, head: SdoHeader, data: bytes) -> None:
        self.head = head
        self.size = head.value
        self.toggle = 0
        self.data = bytearray(data)

    def take(self, segment: bytes) -> bool:
        """Add a segment; return whether it was the last one.

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


class ObjectCodec:
    """SDOs and SDO information of one client to one slave; a SessionCodec.

    Args:
        access: The slave.
        sizes: Of the mailboxes that the client writes to and reads from.
        memory: For what is on its way.
    """

    def __init__(self, access: SlaveAccess, sizes: MailboxSizes, memory: MemoryShare) -> None:
        self.sizes = sizes
        self._access = access
        self._memory = memory
        self._transfer: _Upload | _Download | None = None

    @property
    def is_running(self) -> bool:
        """Whether an SDO in segments is under way."""
        return self._transfer is not None

    def is_step(self, body: bytes) -> bool:
        """Return whether a request is a segment, or asks for one."""
        return _specifier(body) in _SEGMENTS

    def completes_write(self, body: bytes) -> bool:
        """Return whether a request is the last segment of a download."""
        is_segment = _specifier(body) == SdoRequest.DOWNLOAD_SEGMENT
        return is_segment and bool(body[CoeHeader.SIZE] & _LAST)

    def reset(self) -> None:
        """End the SDO that is under way."""
        transfer, self._transfer = self._transfer, None
        if isinstance(transfer, _Upload):
            transfer.stream.close()
        self._memory.hold(0)

    async def answer(self, body: bytes) -> list[bytes]:
        """Return the answers to a message."""
        if len(body) < CoeHeader.SIZE:
            raise TruncatedError("a message of CoE without its header", layout="CoeHeader")
        service, rest = body[1] >> 4, body[CoeHeader.SIZE :]
        if service == CoeService.SDO_REQUEST:
            return await self._sdo(rest)
        if service == CoeService.SDO_INFORMATION:
            return await self._info(rest)
        expects_reply = service not in _UNANSWERED
        message = await self._access.exchange(MailboxType.COE, body, expects_reply=expects_reply)
        return [message.data] if expects_reply else []

    async def _sdo(self, body: bytes) -> list[bytes]:
        specifier = body[0] >> 5 if body else None
        if specifier == SdoRequest.ABORT:
            self.reset()
            return []
        head = SdoHeader(0, 0, 0, 0, 0, 0, 0)
        try:
            if specifier in _SEGMENTS:
                if self._transfer is not None:
                    head = self._transfer.head
                answer = await self._segment(body)
            else:
                self.reset()
                head = SdoHeader.decode(body)
                answer = await self._initiate(head, body[SdoHeader.SIZE :])
        except SdoAbortError as exc:
            self.reset()
            return [encode_abort(head.index, head.subindex, exc.code)]
        return [encode_message(CoeService.SDO_RESPONSE, answer)]

    async def _initiate(self, head: SdoHeader, data: bytes) -> bytes:
        if head.specifier == SdoRequest.UPLOAD:
            return await self._upload(head)
        if head.specifier != SdoRequest.DOWNLOAD:
            raise SdoAbortError(AbortCode.COMMAND, head.index, head.subindex)
        await self._download(head, data)
        index, subindex, complete = head.index, head.subindex, bool(head.complete)
        return encode_plain(SdoResponse.DOWNLOAD, index, subindex, complete=complete)

    async def _upload(self, head: SdoHeader) -> bytes:
        where, complete = (head.index, head.subindex), bool(head.complete)
        stream = await self._access.open_object(*where, complete=complete)
        self._transfer = _Upload(head, stream)
        size, room = stream.size, self.sizes.to_master - INITIATE_OVERHEAD
        if size <= max(room, EXPEDITED_SIZE):
            data = await stream.read(size)
            self.reset()
            return encode_initiate(SdoResponse.UPLOAD, *where, data, complete=complete, room=size)
        self._hold(head, size)
        answer = SdoHeader(1, 0, 0, head.complete, SdoResponse.UPLOAD, *where, size)
        return answer.encode() + await stream.read(room)

    async def _download(self, head: SdoHeader, data: bytes) -> None:
        where, complete = (head.index, head.subindex), bool(head.complete)
        if head.expedited and not head.has_size and not complete:
            await self._access.write_unsized(*where, head.data)
            return
        if head.expedited:
            data = head.data
        elif not head.has_size:
            raise SdoAbortError(AbortCode.COMMAND, *where, "neither expedited nor with a size")
        elif len(data) > head.value:
            raise SdoAbortError(AbortCode.LENGTH, *where, f"{len(data)} octets of {head.value}")
        elif len(data) < head.value:
            self._hold(head, head.value)
            self._transfer = _Download(head, data)
            return
        await self._access.write_object(*where, data, complete=complete)

    async def _segment(self, body: bytes) -> bytes:
        transfer, head = self._transfer, SdoSegmentHeader.decode(body)
        is_upload = head.specifier == SdoRequest.UPLOAD_SEGMENT
        if transfer is None or isinstance(transfer, _Upload) is not is_upload:
            raise SdoAbortError(AbortCode.COMMAND, 0, 0, "no transfer of this kind is under way")
        if head.toggle != transfer.toggle:
            raise SdoAbortError(AbortCode.TOGGLE, transfer.head.index, transfer.head.subindex)
        if isinstance(transfer, _Upload):
            return await self._upload_segment(transfer)
        if transfer.take(body):
            opened = transfer.head
            await self._access.write_object(
                opened.index, opened.subindex, bytes(transfer.data), complete=bool(opened.complete)
            )
            self.reset()
        transfer.toggle ^= 1
        return encode_segment_answer(SdoResponse.DOWNLOAD_SEGMENT, toggle=head.toggle)

    async def _upload_segment(self, upload: _Upload) -> bytes:
        stream, toggle = upload.stream, upload.toggle
        data = await stream.read(self.sizes.to_master - SEGMENT_OVERHEAD)
        upload.toggle ^= 1
        last = stream.done == stream.size
        if last:
            self.reset()
        return encode_segment(SdoResponse.UPLOAD_SEGMENT, data, toggle=toggle, last=last)

    async def _info(self, body: bytes) -> list[bytes]:
        head, query = SdoInfoHeader.decode(body), body[SdoInfoHeader.SIZE :]
        if head.opcode not in _QUERIES:
            raise GatewayError(Cause.SERVICE)
        try:
            answer = await self._access.read_info(head.opcode, query)
            opcode = SdoInfoOpcode(head.opcode + 1)
        except SdoAbortError as exc:
            opcode, answer = SdoInfoOpcode.ERROR, InfoError(exc.code).encode()
        room = self.sizes.data_to_master - CoeHeader.SIZE - SdoInfoHeader.SIZE
        room &= ~1  # no index is cut in two
        pieces = [answer[at : at + room] for at in range(0, len(answer), room)] or [answer]
        return [
            encode_message(
                CoeService.SDO_INFORMATION,
                SdoInfoHeader(opcode, bool(left), fragments_left=left).encode() + piece,
            )
            for left, piece in zip(range(len(pieces) - 1, -1, -1), pieces, strict=True)
        ]

    def _hold(self, head: SdoHeader, size: int) -> None:
        if not self._memory.hold(size):
            detail = f"{size} octets are more than the gateway keeps"
            raise SdoAbortError(AbortCode.OUT_OF_MEMORY, head.index, head.subindex, detail)


def _specifier(body: bytes) -> int | None:
    if len(body) <= CoeHeader.SIZE or body[1] >> 4 != CoeService.SDO_REQUEST:
        return None
    return body[CoeHeader.SIZE] >> 5
