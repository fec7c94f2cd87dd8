"""One client's session with a slave of another station, in one mailbox protocol.

What goes to the other station is a whole transfer, by AoE: an SDO in segments is put together here,
or taken apart.  CoE, SoE and VoE go this way.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from typing import TypeAlias

from devicebus.errors import MailboxRefusedError
from devicebus.mailbox.protocol import MailboxSizes
from devicebus.mailbox.sdo_server import SdoServer
from eap.aoe.ads_operation import Operation, OperationOutcome, Read, Write
from eap.appliance.services.gateway.remote_entries import RemoteEntries
from eap.appliance.services.gateway.slave_session import IDLE_S, Reply, again
from eap.codec.ads import IndexGroup
from eap.codec.coe import CoeHeader, CoeService
from eap.codec.coe import encode_message as encode_coe
from eap.codec.mailbox import MailboxHeader, MailboxType
from eap.codec.sdo import SdoHeader, SdoRequest, encode_abort
from eap.codec.sdoinfo import InfoError, SdoInfoHeader, SdoInfoOpcode
from eap.codec.soe import SoeHeader, SoeOpcode, encode_fragments
from eap.errors import CodecError, TruncatedError
from eap.gateway import elsewhere
from eap.gateway.refusal import Reason, mailbox_error, refuse
from eap.gateway.transfer import Room, Transfer
from eap.od.model import OdState

MAX_WRITTEN = 0x10004
"""Octets of the longest list of SoE that is written in fragments."""
NOT_PASSED = "to slaves of other stations CoE, SoE and VoE are passed on"
_RESPONSE = {
    SoeOpcode.READ_REQUEST: SoeOpcode.READ_RESPONSE,
    SoeOpcode.WRITE_REQUEST: SoeOpcode.WRITE_RESPONSE,
}

Perform: TypeAlias = Callable[[Operation], Awaitable[OperationOutcome]]
"""Has an operation done by the slave; every failure is its result."""


class _RefusedError(Exception):
    def __init__(self, result: int) -> None:
        super().__init__(f"ADS error 0x{result:X}")
        self.result = result


class RemoteSession:
    """What one client does with one slave elsewhere.

    Args:
        kind: The protocol.
        perform: As above.
        room: Octets of the longest answer behind its mailbox header.
        answer_s: How long an answer may take.
    """

    def __init__(self, kind: MailboxType, perform: Perform, *, room: int, answer_s: float) -> None:
        size = room + MailboxHeader.SIZE
        self._kind = kind
        self._perform = perform
        self._room = room
        self._answer_s = answer_s
        self._entries = RemoteEntries()
        self._server = SdoServer(self._entries, _op, MailboxSizes(size, size))
        self._transfer = Transfer(kind, Room(size, size))
        self._written = bytearray()
        self._last: list[Reply] = []
        self._turn = asyncio.Lock()
        self._timer: asyncio.TimerHandle | None = None

    @property
    def is_running(self) -> bool:
        """Whether a transfer is under way."""
        return self._transfer.is_running

    async def ask(self, body: bytes) -> list[Reply]:
        """Return the answers to a request, which may be none."""
        async with self._turn:
            if self._transfer.is_repeated(body):
                return again(self._last)
            self._stop_timer()
            self._transfer.ask(body)
            self._last = await self._answer(body)
            for reply in self._last:
                self._transfer.answer(reply.body)
            if self.is_running:
                self._timer = asyncio.get_running_loop().call_later(IDLE_S, self.close)
            return self._last

    def close(self) -> None:
        """Forget what is under way; the slave has nothing of it yet."""
        self._stop_timer()
        self._server.reset()
        self._written.clear()
        self._transfer.end()

    async def _answer(self, body: bytes) -> list[Reply]:
        try:
            async with asyncio.timeout(self._answer_s):
                match self._kind:
                    case MailboxType.COE:
                        answers = await self._coe(body)
                    case MailboxType.SOE:
                        answers = await self._soe(body)
                    case MailboxType.VOE:
                        answers = [await self._do(elsewhere.vendor_query(body))]
                    case _:
                        return self._refuse(body, Reason.NO_PROTOCOL, NOT_PASSED)
        except TimeoutError:
            return self._refuse(body, Reason.TIMEOUT)
        except MailboxRefusedError as exc:
            return [Reply(*mailbox_error(exc.detail))]
        except CodecError as exc:
            is_cut = isinstance(exc, TruncatedError)
            return self._refuse(body, Reason.TOO_SHORT if is_cut else Reason.SERVICE)
        except _RefusedError as exc:
            self.close()
            return self._tell(body, exc.result)
        return [Reply(self._kind, answer) for answer in answers]

    async def _coe(self, body: bytes) -> list[bytes]:
        service = CoeHeader.decode(body).service
        rest = body[CoeHeader.SIZE :]
        if service is CoeService.SDO_INFORMATION:
            return await self._info(rest)
        if service is not CoeService.SDO_REQUEST:
            raise _RefusedError(Reason.SERVICE.value.ads)
        return await self._sdo(rest)

    async def _sdo(self, body: bytes) -> list[bytes]:
        specifier = body[0] >> 5 if len(body) >= SdoHeader.SIZE else None
        if specifier == SdoRequest.UPLOAD:
            self._entries.octets = await self._read(SdoHeader.decode(body))
        elif specifier == SdoRequest.DOWNLOAD:
            body = await self._with_size(body)
        answers = self._server.receive_request(body)
        new, self._entries.written = self._entries.written, None
        if new is not None:
            offset = elsewhere.sdo_offset(new.index, new.subindex, complete=new.complete)
            await self._do(Write(IndexGroup.SDO, offset, new.data))
        return answers

    async def _with_size(self, body: bytes) -> bytes:
        """Return a download that says how many of its four octets count: as many as the entry."""
        head = SdoHeader.decode(body)
        if not head.expedited or head.has_size or head.complete:
            return body
        unused = 4 - min(4, len(await self._read(head)))
        return bytes((body[0] | unused << 2 | 1,)) + body[1:]

    async def _read(self, head: SdoHeader) -> bytes:
        complete = bool(head.complete)
        offset = elsewhere.sdo_offset(head.index, head.subindex, complete=complete)
        return await self._do(Read(IndexGroup.SDO, offset, elsewhere.ROOM))

    async def _info(self, body: bytes) -> list[bytes]:
        query = elsewhere.info_query(body)
        if query is None:
            raise _RefusedError(Reason.SERVICE.value.ads)
        opcode, operation = query
        try:
            answer = await self._do(operation)
        except _RefusedError as exc:
            if elsewhere.reason_for(exc.result) is not None:
                raise
            opcode = SdoInfoOpcode.ERROR
            answer = InfoError(elsewhere.abort_for(exc.result)).encode()
        room = (self._room - CoeHeader.SIZE - SdoInfoHeader.SIZE) & ~1  # no index is cut in two
        pieces = [answer[at : at + room] for at in range(0, len(answer), room)] or [answer]
        return [
            encode_coe(
                CoeService.SDO_INFORMATION,
                SdoInfoHeader(opcode, bool(left), fragments_left=left).encode() + piece,
            )
            for left, piece in zip(range(len(pieces) - 1, -1, -1), pieces, strict=True)
        ]

    async def _soe(self, body: bytes) -> list[bytes]:
        head, data = SoeHeader.decode(body), body[SoeHeader.SIZE :]
        if head.opcode is SoeOpcode.READ_REQUEST:
            opcode, answer = SoeOpcode.READ_RESPONSE, await self._do(elsewhere.idn_query(head))
        elif head.opcode is SoeOpcode.WRITE_REQUEST:
            self._written += data
            if len(self._written) > MAX_WRITTEN:
                self._written.clear()
                raise _RefusedError(Reason.TOO_LONG.value.ads)
            if head.incomplete:
                return []
            written = bytes(self._written)
            self._written.clear()
            await self._do(elsewhere.idn_query(head, written))
            opcode, answer = SoeOpcode.WRITE_RESPONSE, b""
        else:
            raise _RefusedError(Reason.SERVICE.value.ads)
        told = SoeHeader(opcode, 0, 0, head.drive, head.elements, head.idn)
        return encode_fragments(told, answer, self._room - SoeHeader.SIZE)

    async def _do(self, operation: Operation) -> bytes:
        outcome = await self._perform(operation)
        if outcome.result:
            raise _RefusedError(outcome.result)
        return outcome.data

    def _tell(self, body: bytes, result: int) -> list[Reply]:
        """Say in the protocol of a request why it was refused."""
        reason = elsewhere.reason_for(result)
        if reason is not None:
            return self._refuse(body, reason)
        if self._kind is MailboxType.COE and body[1] >> 4 == CoeService.SDO_REQUEST:
            index, subindex = int.from_bytes(body[3:5], "little"), body[5]
            answer = encode_abort(index, subindex, elsewhere.abort_for(result))
            return [Reply(MailboxType.COE, answer)]
        if self._kind is MailboxType.SOE:
            head = SoeHeader.decode(body)
            if head.opcode in _RESPONSE:
                code = elsewhere.soe_error_for(result).to_bytes(2, "little")
                opcode = _RESPONSE[head.opcode]
                told = SoeHeader(opcode, 0, 1, head.drive, head.elements, head.idn)
                return [Reply(MailboxType.SOE, told.encode() + code)]
        return self._refuse(body, Reason.SERVICE)

    def _refuse(self, body: bytes, reason: Reason, text: str = "") -> list[Reply]:
        return [Reply(*refuse(self._kind, body, reason, text), reason=reason)]

    def _stop_timer(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None


def _op() -> OdState:
    return OdState.OP
