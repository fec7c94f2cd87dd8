"""Asynchronous client of a mailbox gateway, over UDP; see :mod:`eap.gateway.client`."""

from __future__ import annotations

import asyncio
import io
from contextlib import suppress
from functools import partial
from time import monotonic_ns
from types import TracebackType
from typing import Self, TypeVar, cast

from devicebus.mailbox import coe_client, foe_client, soe_client, voe
from devicebus.mailbox.conversation import (
    Conversation,
    MailboxMessage,
    MailboxRequest,
    Progress,
    drive_async,
)
from devicebus.mailbox.protocol import MailboxSizes
from devicebus.mailbox.soe_client import IdnDescription
from eap.codec.coe import EXPEDITED_SIZE, EntryDescription, ObjectDescription
from eap.codec.soe import Element, Idn
from eap.errors import EnvironmentalError
from eap.gateway.conversations import (
    GatewayConversation,
    GatewayConversations,
    PendingRequest,
)
from eap.gateway.slaves import NO_DICTIONARY, MasterSlave, read_sizes, read_slaves

T = TypeVar("T")

PORT = 34980
TIMEOUT_S = 1.0
TRIES = 3
_S = 1_000_000_000


def silence(duration_s: float, transport: str) -> str:
    """Return the text for a gateway that did not answer."""
    return (
        f"was silent for {duration_s:g} s; is it started, and does a firewall let {transport}"
        " through?"
    )


class AsyncGatewayClient:
    """An asynchronous client over UDP.

    Its requests wait for answers side by side, those to one slave by one protocol one after the
    other.

    Args:
        host: Name or address of the gateway.
        port: Its port.
        timeout_s: How long an answer may take before the request is sent again.
        tries: How often it is sent.

    Attributes:
        mailboxes: As :class:`GatewayClient` has them.
    """

    def __init__(
        self, host: str, port: int = PORT, *, timeout_s: float = TIMEOUT_S, tries: int = TRIES
    ) -> None:
        self.mailboxes: dict[int, MailboxSizes] = {}
        self._has_dictionary = True
        self._address = host, port
        self._link = _Datagrams(
            GatewayConversations(
                timeout_ns=round(timeout_s * _S),
                tries=tries,
                silence=f"gateway {host}:{port} {silence(timeout_s * tries, 'UDP')}",
            )
        )

    async def __aenter__(self) -> Self:
        loop = asyncio.get_running_loop()
        try:
            await loop.create_datagram_endpoint(lambda: self._link, remote_addr=self._address)
        except OSError as exc:
            host, port = self._address
            raise EnvironmentalError(f"gateway {host}:{port}: {exc.strerror or exc}") from None
        return self

    async def __aexit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._link.close()

    async def sdo_read(
        self, address: int, index: int, subindex: int = 0, *, complete: bool = False
    ) -> bytes:
        """Read an entry, or with *complete* a whole object."""
        return await self.converse(address, coe_client.upload(index, subindex, complete=complete))

    async def sdo_write(
        self, address: int, index: int, subindex: int, data: bytes, *, complete: bool = False
    ) -> None:
        """Write an entry, or with *complete* a whole object."""
        is_short = len(data) <= EXPEDITED_SIZE
        sizes = MailboxSizes() if is_short else await self._sizes_or_default(address)
        conversation = coe_client.download(index, subindex, data, sizes, complete=complete)
        await self.converse(address, conversation)

    async def od_list(self, address: int) -> list[int]:
        """Read the indexes of all objects."""
        return await self.converse(address, coe_client.object_list())

    async def od_object(self, address: int, index: int) -> ObjectDescription:
        """Read the description of an object."""
        return await self.converse(address, coe_client.object_description(index))

    async def od_entry(self, address: int, index: int, subindex: int) -> EntryDescription:
        """Read the description of an entry."""
        return await self.converse(address, coe_client.entry_description(index, subindex))

    async def foe_read(
        self, address: int, name: str, *, password: int = 0, progress: Progress | None = None
    ) -> bytes:
        """Read a file."""
        content = io.BytesIO()
        sizes = await self.sizes_of(address)
        conversation = foe_client.read(
            name, content.write, sizes, password=password, progress=progress
        )
        await self.converse(address, conversation)
        return content.getvalue()

    async def foe_write(
        self,
        address: int,
        name: str,
        data: bytes,
        *,
        password: int = 0,
        progress: Progress | None = None,
    ) -> None:
        """Write a file."""
        sizes = await self.sizes_of(address)
        source = io.BytesIO(data).read
        conversation = foe_client.write(name, source, sizes, password=password, progress=progress)
        await self.converse(address, conversation)

    async def idn_read(
        self, address: int, idn: Idn, elements: int = Element.VALUE, *, drive: int = 0
    ) -> bytes:
        """Read elements of an IDN, one behind the other."""
        return await self.converse(address, soe_client.read(idn, elements, drive=drive))

    async def idn_describe(self, address: int, idn: Idn, *, drive: int = 0) -> IdnDescription:
        """Read all elements of an IDN in one view."""
        return await self.converse(address, soe_client.describe(idn, drive=drive))

    async def idn_write(
        self,
        address: int,
        idn: Idn,
        data: bytes,
        *,
        element: int = Element.VALUE,
        drive: int = 0,
    ) -> None:
        """Write an element of an IDN; a list or text with its head."""
        sizes = await self._sizes_or_default(address)
        conversation = soe_client.write(idn, data, sizes, elements=element, drive=drive)
        await self.converse(address, conversation)

    async def voe(self, address: int, vendor_id: int, vendor_type: int, data: bytes) -> bytes:
        """Send data of a vendor's protocol; return the data of its answer."""
        return await self.converse(address, voe.exchange(vendor_id, vendor_type, data))

    async def slaves(self) -> list[MasterSlave]:
        """Return the slaves that the master knows."""
        return await self.converse(0, read_slaves())

    async def sizes_of(self, address: int) -> MailboxSizes:
        """Return the mailboxes of a slave; raises as :meth:`GatewayClient.sizes_of`."""
        if known := self.mailboxes.get(address):
            return known
        return await self.converse(0, read_sizes(address))

    async def _sizes_or_default(self, address: int) -> MailboxSizes:
        """Return the mailboxes of a slave, for messages that may as well be shorter."""
        if self._has_dictionary:
            with suppress(*NO_DICTIONARY):
                return await self.sizes_of(address)
            self._has_dictionary = False  # each question would wait for as long
        return self.mailboxes.get(address, MailboxSizes())

    async def converse(self, address: int, conversation: Conversation[T]) -> T:
        """Run any conversation."""
        place = GatewayConversation(address)
        try:
            return await drive_async(conversation, partial(self._link.exchange, place))
        finally:
            self._link.end(place)


class _Datagrams(asyncio.DatagramProtocol):
    """Socket and timer of the conversations of one client."""

    def __init__(self, conversations: GatewayConversations) -> None:
        self._conversations = conversations
        self._transport: asyncio.DatagramTransport | None = None
        self._timer: asyncio.TimerHandle | None = None
        self._results: dict[PendingRequest, asyncio.Future[None]] = {}

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Keep the transport (asyncio)."""
        # No instance of DatagramTransport, though it has all its methods (Python 3.11).
        self._transport = cast("asyncio.DatagramTransport", transport)

    def datagram_received(self, data: bytes, addr: object) -> None:
        """Take a frame (asyncio)."""
        self._conversations.receive_frame(data, monotonic_ns())
        self._go_on()

    async def exchange(self, place: GatewayConversation, ask: MailboxRequest) -> MailboxMessage:
        """Make a request, and wait for its result."""
        request = self._conversations.request(place, ask, monotonic_ns())
        self._results[request] = result = asyncio.get_running_loop().create_future()
        self._go_on()
        try:
            await result
        finally:
            self._results.pop(request, None)
        return request.result()

    def end(self, place: GatewayConversation) -> None:
        """End a conversation."""
        self._conversations.close(place, monotonic_ns())
        self._go_on()

    def close(self) -> None:
        """Close the socket."""
        if self._transport is not None:
            self._transport.close()

    def _go_on(self) -> None:
        """Send pending frames, deliver results and set the timer."""
        core = self._conversations
        for frame in core.frames_to_send(monotonic_ns()):
            if self._transport is not None:
                self._transport.sendto(frame)
        while (request := core.next_event()) is not None:
            result = self._results.pop(request, None)
            if result is not None and not result.done():
                result.set_result(None)
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        due_ns = core.next_timeout()
        if due_ns is not None:
            wait_s = max(0, due_ns - monotonic_ns()) / _S
            self._timer = asyncio.get_running_loop().call_later(wait_s, self._ring)

    def _ring(self) -> None:
        self._conversations.handle_timeout(monotonic_ns())
        self._go_on()
