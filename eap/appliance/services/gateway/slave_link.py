"""What a gateway needs of the bus behind it."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from typing import Protocol, TypeVar

from devicebus.mailbox.conversation import Conversation
from eap.appliance.bus_request import BusReport, Heard
from eap.appliance.handover import PortName
from eap.appliance.services.bus.bus_client import BusClient
from eap.appliance.services.bus.bus_talk import Talk
from eap.codec.mailbox import MailboxType

T = TypeVar("T")


class SlaveLink(Protocol):
    """The bus behind a gateway, as ``BusClient`` has it for one port."""

    async def describe(self) -> BusReport:
        """Return how the bus is."""

    async def open_talk(self, station: int, kind: MailboxType, requester: Hashable) -> Talk:
        """Wait for a turn at the mailbox of a slave."""

    async def converse(self, station: int, conversation: Conversation[T], requester: Hashable) -> T:
        """Lead a conversation with a slave."""

    def listen(self, heard: Callable[[Heard], None]) -> None:
        """Call *heard* with each message that a slave sends unasked."""


class PortLink:
    """The bus of one port."""

    def __init__(self, client: BusClient, port: PortName) -> None:
        self._client = client
        self._port = port

    def listen(self, heard: Callable[[Heard], None]) -> None:
        """Call *heard* with each message that a slave sends unasked."""
        self._client.listen(self._port, heard)

    async def describe(self) -> BusReport:
        """Return how the bus is."""
        return await self._client.describe(self._port)

    async def open_talk(self, station: int, kind: MailboxType, requester: Hashable) -> Talk:
        """Wait for a turn at the mailbox of a slave."""
        return await self._client.open_talk(self._port, station, kind, requester)

    async def converse(self, station: int, conversation: Conversation[T], requester: Hashable) -> T:
        """Lead a conversation with a slave."""
        return await self._client.converse(self._port, station, conversation, requester)
