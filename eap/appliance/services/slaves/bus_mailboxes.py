"""Mailboxes of the slaves on one bus: conversations with them, and messages sent unasked."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from typing import TypeVar

from devicebus.mailbox.conversation import Conversation
from eap.appliance.bus_request import UnsolicitedMessage
from eap.appliance.handover import PortName
from eap.appliance.services.bus.bus_client import BusClient
from eap.appliance.services.bus.mailbox_queue import MailboxTurn
from eap.codec.mailbox import MailboxType

T = TypeVar("T")


class BusMailboxes:
    """The bus client, narrowed to one port.

    Attributes:
        view: Cached description of the bus.
    """

    def __init__(self, client: BusClient, port: PortName) -> None:
        self.view = client.views[port]
        self._client = client
        self._port = port

    def listen(self, receive: Callable[[UnsolicitedMessage], None]) -> None:
        """Call *receive* with each message that a slave sends unasked."""
        self._client.listen(self._port, receive)

    async def open_turn(
        self, station: int, kind: MailboxType, requester: Hashable, turn_s: float | None = None
    ) -> MailboxTurn:
        """Wait for a turn at the mailbox of a slave; raises as ``BusClient.open_turn``."""
        return await self._client.open_turn(self._port, station, kind, requester, turn_s)

    async def converse(
        self,
        station: int,
        conversation: Conversation[T],
        requester: Hashable,
        turn_s: float | None = None,
    ) -> T:
        """Drive a conversation with a slave to its end; raises as ``BusClient.converse``."""
        return await self._client.converse(self._port, station, conversation, requester, turn_s)
