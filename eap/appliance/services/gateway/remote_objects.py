"""CoE to a slave of another station: SDOs are put together here, or taken apart."""

from __future__ import annotations

from devicebus.mailbox.protocol import MailboxSizes
from devicebus.mailbox.sdo_server import SdoServer
from eap.aoe.ads_operation import Read, Write
from eap.appliance.services.gateway.remote_entries import RemoteEntries
from eap.appliance.services.gateway.remote_link import RemoteLink
from eap.codec.ads import IndexGroup
from eap.codec.coe import CoeHeader, CoeService
from eap.codec.coe import encode_message as encode_coe
from eap.codec.sdo import SdoHeader, SdoRequest
from eap.codec.sdoinfo import InfoError, SdoInfoHeader, SdoInfoOpcode
from eap.gateway import elsewhere
from eap.gateway.elsewhere import ElsewhereError
from eap.gateway.refusal import Reason
from eap.od.model import OdState


class RemoteObjects:
    """The dictionary of a slave elsewhere, for one client; a Speaker.

    Args:
        link: Leads to the slave.
        sizes: Of mailboxes, as the client is to know them.
    """

    def __init__(self, link: RemoteLink, sizes: MailboxSizes) -> None:
        self.sizes = sizes
        self._link = link
        self._entries = RemoteEntries()
        self._server = SdoServer(self._entries, _op, self.sizes)

    def reset(self) -> None:
        """Forget the SDO that is under way."""
        self._server.reset()

    async def answer(self, body: bytes) -> list[bytes]:
        """Return the answers to a message."""
        service = CoeHeader.decode(body).service
        rest = body[CoeHeader.SIZE :]
        if service is CoeService.SDO_INFORMATION:
            return await self._info(rest)
        if service is not CoeService.SDO_REQUEST:
            raise ElsewhereError(Reason.SERVICE.value.ads)
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
            await self._link.perform(Write(IndexGroup.SDO, offset, new.data))
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
        return await self._link.perform(Read(IndexGroup.SDO, offset, elsewhere.ROOM))

    async def _info(self, body: bytes) -> list[bytes]:
        query = elsewhere.info_query(body)
        if query is None:
            raise ElsewhereError(Reason.SERVICE.value.ads)
        opcode, operation = query
        try:
            answer = await self._link.perform(operation)
        except ElsewhereError as exc:
            if elsewhere.reason_for(exc.result) is not None:
                raise
            opcode = SdoInfoOpcode.ERROR
            answer = InfoError(elsewhere.abort_for(exc.result)).encode()
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


def _op() -> OdState:
    return OdState.OP
