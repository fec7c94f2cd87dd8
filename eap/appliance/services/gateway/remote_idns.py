"""SoE and VoE to a slave of another station."""

from __future__ import annotations

from devicebus.mailbox.protocol import MailboxSizes
from eap.appliance.services.gateway.remote_link import RemoteLink
from eap.codec.soe import SoeHeader, SoeOpcode, encode_fragments
from eap.gateway import elsewhere
from eap.gateway.elsewhere import ElsewhereError
from eap.gateway.refusal import Reason

MAX_WRITTEN = 0x10004
"""Octets of the longest list of SoE that is written in fragments."""


class RemoteIdns:
    """The IDNs of a slave elsewhere, for one client; a Speaker.

    Args:
        link: Leads to the slave.
        sizes: Of mailboxes, as the client is to know them.
    """

    def __init__(self, link: RemoteLink, sizes: MailboxSizes) -> None:
        self.sizes = sizes
        self._link = link
        self._written = bytearray()

    def reset(self) -> None:
        """Forget the fragments that came so far."""
        self._written.clear()

    async def answer(self, body: bytes) -> list[bytes]:
        """Return the answers to a message; fragments before the last one have none."""
        head, data = SoeHeader.decode(body), body[SoeHeader.SIZE :]
        if head.opcode is SoeOpcode.READ_REQUEST:
            opcode, answer = SoeOpcode.READ_RESPONSE, await self._do(head)
        elif head.opcode is SoeOpcode.WRITE_REQUEST:
            self._written += data
            if len(self._written) > MAX_WRITTEN:
                raise ElsewhereError(Reason.TOO_LONG.value.ads)
            if head.incomplete:
                return []
            written = bytes(self._written)
            self._written.clear()
            await self._do(head, written)
            opcode, answer = SoeOpcode.WRITE_RESPONSE, b""
        else:
            raise ElsewhereError(Reason.SERVICE.value.ads)
        told = SoeHeader(opcode, 0, 0, head.drive, head.elements, head.idn)
        return encode_fragments(told, answer, self.sizes.data_to_master - SoeHeader.SIZE)

    async def _do(self, head: SoeHeader, data: bytes | None = None) -> bytes:
        return await self._link.perform(elsewhere.idn_query(head, data))


class RemoteVendor:
    """Messages of vendors' protocols to a slave elsewhere; a Speaker.

    Args:
        link: Leads to the slave.
    """

    def __init__(self, link: RemoteLink) -> None:
        self.sizes = MailboxSizes()
        self._link = link

    def reset(self) -> None:
        """Nothing is ever under way."""

    async def answer(self, body: bytes) -> list[bytes]:
        """Return the answer to a message."""
        return [await self._link.perform(elsewhere.vendor_query(body))]
