"""CoE in front of a slave: SDOs of a client as whole operations on the slave's objects.

An upload is read from the slave to its end at the slave's speed, and answered out of memory; its
first answer goes out as soon as the size and the first octets are there.  A download is collected,
and written when its last segment is there (ETG.1000.6 knows one SDO of a server at a time, so a
client that pauses in the middle of one would keep the slave from all others).
"""

from __future__ import annotations

from devicebus.mailbox.coe_server import (
    SEGMENTS,
    SegmentedTransfer,
    size_of_download,
    transfer_of,
)
from devicebus.mailbox.protocol import MailboxSizes
from eap.codec.coe import (
    EXPEDITED_SIZE,
    INITIATE_OVERHEAD,
    SEGMENT_OVERHEAD,
    CoeHeader,
    CoeService,
    InfoError,
    SdoHeader,
    SdoInfoHeader,
    SdoInfoOpcode,
    SdoRequest,
    SdoResponse,
    encode_abort,
    encode_initiate,
    encode_message,
    encode_plain,
    encode_segment,
    encode_segment_answer,
)
from eap.codec.mailbox import MailboxType
from eap.errors import TruncatedError
from eap.gateway.error_table import Cause
from eap.gateway.refusal import GatewayError
from eap.gateway.request_tracker import MemoryShare
from eap.od.abort import AbortCode, SdoAbortError
from eap.services.slaves.access import SlaveAccess
from eap.services.slaves.object_stream import ObjectStream

_LAST = 0x01
_UNANSWERED = frozenset((CoeService.TX_PDO, CoeService.RX_PDO, CoeService.EMERGENCY))
_QUERIES = frozenset(
    (SdoInfoOpcode.LIST_REQUEST, SdoInfoOpcode.OBJECT_REQUEST, SdoInfoOpcode.ENTRY_REQUEST)
)


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
        self._transfer: SegmentedTransfer | None = None
        self._stream: ObjectStream | None = None

    @property
    def is_running(self) -> bool:
        """Whether an SDO in segments is under way."""
        return self._transfer is not None or self._stream is not None

    def is_step(self, body: bytes) -> bool:
        """Return whether a request is a segment, or asks for one."""
        return _specifier(body) in SEGMENTS

    def completes_write(self, body: bytes) -> bool:
        """Return whether a request is the last segment of a download."""
        is_segment = _specifier(body) == SdoRequest.DOWNLOAD_SEGMENT
        return is_segment and bool(body[CoeHeader.SIZE] & _LAST)

    def reset(self) -> None:
        """End the SDO that is under way."""
        self._transfer = None
        stream, self._stream = self._stream, None
        if stream is not None:
            stream.close()
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
            if specifier in SEGMENTS:
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
        stream = self._stream = await self._access.open_object(*where, complete=complete)
        size, room = stream.size, self.sizes.to_master - INITIATE_OVERHEAD
        if size <= max(room, EXPEDITED_SIZE):
            data = await stream.read(size)
            self.reset()
            return encode_initiate(SdoResponse.UPLOAD, *where, data, complete=complete, room=size)
        self._hold(head, size)
        self._transfer = SegmentedTransfer(head, size)
        answer = SdoHeader(1, 0, 0, head.complete, SdoResponse.UPLOAD, *where, size)
        return answer.encode() + await stream.read(room)

    async def _download(self, head: SdoHeader, data: bytes) -> None:
        where, complete = (head.index, head.subindex), bool(head.complete)
        if head.expedited and not head.has_size and not complete:
            await self._access.write_unsized(*where, head.data)
            return
        if head.expedited:
            data = head.data
        elif len(data) < (size := size_of_download(head, data)):
            self._hold(head, size)
            self._transfer = SegmentedTransfer(head, size, data)
            return
        await self._access.write_object(*where, data, complete=complete)

    async def _segment(self, body: bytes) -> bytes:
        transfer = transfer_of(body, self._transfer)
        head, toggle = transfer.head, transfer.toggle
        if self._stream is not None:
            answer = await self._upload_segment(self._stream, toggle)
        else:
            if transfer.add_segment(body):
                data, complete = bytes(transfer.data), bool(head.complete)
                await self._access.write_object(head.index, head.subindex, data, complete=complete)
                self.reset()
            answer = encode_segment_answer(SdoResponse.DOWNLOAD_SEGMENT, toggle=toggle)
        transfer.toggle ^= 1
        return answer

    async def _upload_segment(self, stream: ObjectStream, toggle: int) -> bytes:
        data = await stream.read(self.sizes.to_master - SEGMENT_OVERHEAD)
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
