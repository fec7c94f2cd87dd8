"""What stands behind the index groups of a slave: the part of its mailbox that serves them."""

from __future__ import annotations

from collections.abc import Collection
from typing import NamedTuple, NoReturn, TypeVar

from devicebus.mailbox.conversation import Conversation
from devicebus.mailbox.protocol import MailboxSizes
from devicebus.wire.sii import SiiProtocol
from eap.aoe.ads_notifications import Client
from eap.aoe.ads_operation import AdsRefusedError
from eap.appliance.bus_request import SlaveDescription
from eap.appliance.handover import PortName
from eap.appliance.services.bus.bus_client import BusClient
from eap.codec.ads import AdsError

T = TypeVar("T")


class Asked(NamedTuple):
    """A slave, and who wants something of it."""

    slave: SlaveDescription
    client: Client

    @property
    def sizes(self) -> MailboxSizes:
        """Of the slave's mailboxes."""
        return MailboxSizes(self.slave.to_slave, self.slave.to_master)


class SlaveSpace:
    """A family of index groups; what a space does not override is refused.

    All of its methods may raise AdsRefusedError, and whatever ``results.refusal`` knows.

    Args:
        bus: Talks to the slaves.
        port: Where they are.

    Attributes:
        groups: That it answers for.
        protocol: That a slave has to speak.
    """

    groups: Collection[int] = ()
    protocol = SiiProtocol(0)

    def __init__(self, bus: BusClient, port: PortName) -> None:
        self.bus = bus
        self.port = port

    async def read(self, asked: Asked, group: int, offset: int, length: int) -> bytes:
        """Return what is there; the caller sees to it that it fits *length*."""
        del asked, group, offset, length
        _refuse()

    async def write(self, asked: Asked, group: int, offset: int, data: bytes) -> None:
        """Write *data*."""
        del asked, group, offset, data
        _refuse()

    async def read_write(
        self, asked: Asked, group: int, offset: int, length: int, data: bytes
    ) -> bytes:
        """Write *data*, if there is any, then return what is there."""
        if data:
            await self.write(asked, group, offset, data)
        return await self.read(asked, group, offset, length)

    async def converse(self, asked: Asked, conversation: Conversation[T]) -> T:
        """Lead a conversation with the slave, when it is the client's turn."""
        return await self.bus.converse(self.port, asked.slave.station, conversation, asked.client)


def _refuse() -> NoReturn:
    raise AdsRefusedError(AdsError.SERVICE)
