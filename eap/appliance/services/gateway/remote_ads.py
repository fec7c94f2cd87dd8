"""AoE to a slave of another station: the request goes on by the router, under our own address.

The client need not know the NetID of the bus there: whom it is for is what its mailbox address
means, and the answer comes back from whom the client named.
"""

from __future__ import annotations

from time import monotonic_ns

from devicebus.mailbox.protocol import MailboxSizes
from eap.aoe.answer import response_to
from eap.aoe.fragment import Assembler, iter_fragments
from eap.appliance.services.gateway.remote_link import RemoteLink
from eap.codec.ams import AmsCommand, AmsHeader, StateFlags, decode_packet
from eap.gateway.elsewhere import ElsewhereError
from eap.gateway.refusal import Reason

_PASSED = frozenset(
    (
        AmsCommand.READ_DEVICE_INFO,
        AmsCommand.READ,
        AmsCommand.WRITE,
        AmsCommand.READ_STATE,
        AmsCommand.WRITE_CONTROL,
        AmsCommand.READ_WRITE,
    )
)
"""Notifications are not: nobody would bring them back."""


class RemoteAds:
    """The ADS services of a slave elsewhere, for one client; a Speaker.

    Args:
        link: Leads to the slave.
        sizes: Of mailboxes, as the client is to know them.
    """

    def __init__(self, link: RemoteLink, sizes: MailboxSizes) -> None:
        self.sizes = sizes
        self._link = link
        self._assembler = Assembler()
        self._number = 0

    def reset(self) -> None:
        """Forget the fragments that came so far."""
        self._assembler.reset()

    async def answer(self, body: bytes) -> list[bytes]:
        """Return the answers to a packet, or to a fragment of one."""
        header, data = decode_packet(body)
        if header.state_flags & StateFlags.RESPONSE:
            return []  # to our fragments, which nobody has to acknowledge
        if header.command == AmsCommand.FRAGMENT:
            packet, acknowledgement = self._assembler.receive(header, bytes(data), monotonic_ns())
            if packet is None:
                return [acknowledgement] if acknowledgement else []
            header, data = decode_packet(packet)
        if header.command not in _PASSED:
            raise ElsewhereError(Reason.SERVICE.value.ads)
        answer = await self._link.pass_on(header.command, bytes(data))
        if header.state_flags & StateFlags.NO_RETURN:
            return []
        packet, room = response_to(header, answer), self.sizes.data_to_master
        if len(packet) <= room:
            return [packet]
        self._number += 1
        return list(iter_fragments(packet, self._number, room - AmsHeader.SIZE))
