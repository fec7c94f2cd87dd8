"""CoE and FoE in front of a slave: transfers of one client as whole operations on the slave.

An upload is read from the slave to its end at the slave's speed, and answered out of memory; its
first answer goes out as soon as the size and the first bytes are there.  A download is collected,
and written when its last segment is there (ETG.1000.6: a server handles one SDO at a time, so a
client that pauses in the middle of one would block the slave for all others).

A file is fetched ahead of its client, or written behind it.  While the client has to wait it is
answered BUSY; a client that stops blocks the slave no longer than its session lasts (ETG.1000.6: a
server handles one file at a time).
"""

from __future__ import annotations

import asyncio

from devicebus.errors import FoeError
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
    encode_plain,
    encode_segment,
    encode_segment_answer,
)
from eap.codec.coe import encode_message as encode_coe
from eap.codec.foe import (
    DATA_OVERHEAD,
    Busy,
    FoeErrorCode,
    FoeHeader,
    FoeOpcode,
    text_of,
)
from eap.codec.foe import encode_message as encode_foe
from eap.codec.mailbox import MailboxHeader, MailboxType
from eap.errors import MalformedError, TruncatedError
from eap.gateway.error_table import Cause
from eap.gateway.request_tracker import MemoryShare
from eap.gateway.requests import GatewayError
from eap.od.abort import AbortCode, SdoAbortError
from eap.services.slaves.access import ObjectStream, SlaveAccess
from eap.services.slaves.file_stream import FileStream

_LAST = 0x01
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
        """True if a segmented SDO is active."""
        return self._transfer is not None or self._stream is not None

    def is_step(self, body: bytes) -> bool:
        """Return whether a request is a segment, or asks for one."""
        return _specifier(body) in SEGMENTS

    def completes_write(self, body: bytes) -> bool:
        """Return whether a request is the last segment of a download."""
        is_segment = _specifier(body) == SdoRequest.DOWNLOAD_SEGMENT
        return is_segment and bool(body[CoeHeader.SIZE] & _LAST)

    def reset(self) -> None:
        """Abort the active SDO."""
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
        # An RxPDO has no confirmation; a slave refuses what it does not know by a mailbox error.
        expects_reply = service != CoeService.RX_PDO
        message = await self._access.exchange(MailboxType.COE, body, expects_reply=expects_reply)
        return [message.data] if expects_reply else []

    async def _sdo(self, body: bytes) -> list[bytes]:
        specifier = body[0] >> 5 if body else None
        # An abort of the client has no answer (ETG.1000.6).
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
        return [encode_coe(CoeService.SDO_RESPONSE, answer)]

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
        # Up to 4 bytes go in the header itself, whatever the size of the mailbox.
        if size <= max(room, EXPEDITED_SIZE):
            data = await stream.read(size)
            self.reset()
            return encode_initiate(
                SdoResponse.UPLOAD, *where, data, complete=complete, max_size=size
            )
        self._hold(head, size)
        self._transfer = SegmentedTransfer(head, size)
        answer = SdoHeader(1, 0, 0, head.complete, SdoResponse.UPLOAD, *where, size)
        return answer.encode() + await stream.read(room)

    async def _download(self, head: SdoHeader, data: bytes) -> None:
        where, complete = (head.index, head.subindex), bool(head.complete)
        # Without a size the slave's own entry decides how many of the 4 bytes count (ETG.1000.6).
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
            encode_coe(
                CoeService.SDO_INFORMATION,
                SdoInfoHeader(opcode, bool(left), fragments_left=left).encode() + piece,
            )
            for left, piece in zip(range(len(pieces) - 1, -1, -1), pieces, strict=True)
        ]

    def _hold(self, head: SdoHeader, size: int) -> None:
        if not self._memory.hold(size):
            detail = f"{size} bytes exceed the memory of the gateway"
            raise SdoAbortError(AbortCode.OUT_OF_MEMORY, head.index, head.subindex, detail)


def _specifier(body: bytes) -> int | None:
    if len(body) <= CoeHeader.SIZE or body[1] >> 4 != CoeService.SDO_REQUEST:
        return None
    return body[CoeHeader.SIZE] >> 5


AHEAD = 4 << 20
"""Octets of a file that are fetched ahead of a client, as far as there is memory for them."""
_LEAST_AHEAD = 64 << 10
_BUSY = encode_foe(FoeOpcode.BUSY, Busy(0, 100).number)
_STEPS = frozenset((FoeOpcode.DATA, FoeOpcode.ACK))


class FileCodec:
    """The file that one client reads or writes; a SessionCodec.

    Args:
        access: The slave.
        sizes: Of its mailboxes, until a file is open: what fills them is not a file's last packet.
        memory: For what is fetched ahead.
        wait_s: How long the client waits before it is answered BUSY.
    """

    def __init__(
        self, access: SlaveAccess, sizes: MailboxSizes, memory: MemoryShare, wait_s: float
    ) -> None:
        self.sizes = sizes
        self._access = access
        self._memory = memory
        self._wait_s = wait_s
        self._file: FileStream | None = None
        self._opened = b""
        self._is_write = self._is_last = self._is_taken = False
        self._number: int | None = None
        self._sent = b""

    @property
    def is_running(self) -> bool:
        """True if a file is open, or is to be opened when the slave has time."""
        return self._file is not None

    @property
    def stalled_s(self) -> float:
        """Time that the slave has waited for this client, see StallMeter."""
        now_s = asyncio.get_running_loop().time()
        return 0.0 if self._file is None else self._file.stalls.total_s(now_s)

    @property
    def waits_for_lock(self) -> bool:
        """True if this file waits for those of other clients."""
        return self._file is not None and not self._file.has_lock

    def is_step(self, body: bytes) -> bool:
        """Return whether a request is a packet, or confirms one."""
        return body[:1] in {bytes((opcode,)) for opcode in _STEPS}

    def completes_write(self, body: bytes) -> bool:
        """Return False: BUSY answers a step that takes long."""
        del body
        return False

    def reset(self) -> None:
        """Abort the file if it is not complete."""
        file, self._file = self._file, None
        if file is not None:
            file.close()
        self._memory.hold(0)

    async def answer(self, body: bytes) -> list[bytes]:
        """Return the answer to a message: BUSY if it has to wait and the slave is still there."""
        try:
            head = FoeHeader.decode(body)
        except MalformedError:
            self.reset()
            return [encode_foe(FoeOpcode.ERROR, FoeErrorCode.ILLEGAL)]
        if head.opcode is FoeOpcode.ERROR:
            self.reset()
            return []
        if head.opcode is FoeOpcode.DATA and len(body) + MailboxHeader.SIZE > self.sizes.to_slave:
            raise GatewayError(Cause.TOO_LONG)
        try:
            async with asyncio.timeout(self._wait_s):
                return await self._step(head, body)
        except TimeoutError:
            # BUSY would keep the client waiting for ever if the station of the slave is gone.
            await self._access.probe()
            return [_BUSY]
        except FoeError as exc:
            self.reset()
            text = exc.text.encode()[: self.sizes.data_to_master - FoeHeader.SIZE]
            return [encode_foe(FoeOpcode.ERROR, exc.code, text)]

    async def _step(self, head: FoeHeader, body: bytes) -> list[bytes]:
        """Execute one step; one that was answered BUSY continues when it is repeated."""
        data = body[FoeHeader.SIZE :]
        if head.opcode in {FoeOpcode.READ, FoeOpcode.WRITE}:
            return await self._open(body, text_of(data), head)
        if self._file is not None and self._number is not None:
            if head.opcode is FoeOpcode.DATA and self._is_write:
                return await self._take(self._file, head.number, data)
            if head.opcode is FoeOpcode.ACK and not self._is_write:
                if head.number != self._number:
                    raise _wrong_number(head.number, self._number)
                if self._is_last:
                    self.reset()
                    return []
                return await self._send_next(self._file)
            if head.opcode is FoeOpcode.BUSY and not self._is_write:
                return [self._sent]
        text = f"{head.opcode.name} without a transfer"
        raise FoeError(text, code=FoeErrorCode.ILLEGAL, text=text)

    async def _open(self, body: bytes, name: str, head: FoeHeader) -> list[bytes]:
        file = self._file
        # The same request again continues an opening that was answered BUSY.
        if file is None or self._number is not None or body != self._opened:
            self.reset()
            self._opened, self._is_write = body, head.opcode is FoeOpcode.WRITE
            self._number, self._is_last, self._is_taken = None, False, False
            ahead = AHEAD if not self._is_write and self._memory.hold(AHEAD) else _LEAST_AHEAD
            file = self._access.open_file(name, head.number, is_write=self._is_write, ahead=ahead)
            self._file = file
        await file.wait_open()
        self.sizes = file.sizes
        if not self._is_write:
            return await self._send_next(file)
        self._number = 0
        return [encode_foe(FoeOpcode.ACK, 0)]

    async def _send_next(self, file: FileStream) -> list[bytes]:
        room = self.sizes.to_master - DATA_OVERHEAD
        data = await file.read(room)
        self._number = (self._number or 0) + 1
        # A file whose size is a multiple of the packet ends with an empty packet (ETG.1000.6).
        self._is_last = len(data) < room
        self._sent = encode_foe(FoeOpcode.DATA, self._number, data)
        return [self._sent]

    async def _take(self, file: FileStream, number: int, data: bytes) -> list[bytes]:
        if number != (self._number or 0) + 1:
            raise _wrong_number(number, (self._number or 0) + 1)
        if not self._is_taken:
            await file.write(data)
            self._is_taken = True  # also if its end takes longer
        # A packet that does not fill the mailbox is the last one of a file (ETG.1000.6).
        if len(data) < self.sizes.to_slave - DATA_OVERHEAD:
            await file.finish()
            self.reset()
        self._number, self._is_taken = number, False
        return [encode_foe(FoeOpcode.ACK, number)]


def _wrong_number(number: int, expected: int) -> FoeError:
    text = f"packet {number}, expected {expected}"
    return FoeError(text, code=FoeErrorCode.PACKET_NUMBER, text=text)
