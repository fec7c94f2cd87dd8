"""The asynchronous client of a mailbox gateway, over UDP; see :mod:`eap.gateway.client`."""

from __future__ import annotations

import asyncio
import io
from contextlib import suppress
from types import TracebackType
from typing import Self, TypeVar, cast

from devicebus.mailbox import (
    coe_client,
    coeinfo_client,
    foe_client,
    soe_browse,
    soe_client,
    voe_client,
)
from devicebus.mailbox.conversation import Conversation, Progress
from devicebus.mailbox.protocol import MailboxSizes
from devicebus.mailbox.soe_browse import IdnDescription
from eap.codec.sdo import EXPEDITED_SIZE
from eap.codec.sdoinfo import EntryDescription, ObjectDescription
from eap.codec.soe import Element, Idn
from eap.errors import EnvironmentalError
from eap.gateway.dialogue import Dialogue, patience
from eap.gateway.slaves import NOT_TOLD, MasterSlave, not_told, read_slaves, sizes_of

T = TypeVar("T")

PORT = 34980
TIMEOUT_S = 1.0
TRIES = 3
_S = 1_000_000_000


class AsyncGatewayClient:
    """An asynchronous client over UDP; its requests may wait for answers side by side.

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
        self._master_tells = True
        self._place = host, port
        self._timeout_s = timeout_s
        self._tries = tries
        self._counter = 0
        self._protocol = _Datagrams()

    async def __aenter__(self) -> Self:
        loop = asyncio.get_running_loop()
        try:
            await loop.create_datagram_endpoint(lambda: self._protocol, remote_addr=self._place)
        except OSError as exc:
            host, port = self._place
            raise EnvironmentalError(f"gateway {host}:{port}: {exc.strerror or exc}") from None
        return self

    async def __aexit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._protocol.close()

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
        talk = coe_client.download(index, subindex, data, sizes, complete=complete)
        await self.converse(address, talk)

    async def od_list(self, address: int) -> list[int]:
        """Read the indexes of all objects."""
        return await self.converse(address, coeinfo_client.object_list())

    async def od_object(self, address: int, index: int) -> ObjectDescription:
        """Read what is said of an object."""
        return await self.converse(address, coeinfo_client.object_description(index))

    async def od_entry(self, address: int, index: int, subindex: int) -> EntryDescription:
        """Read what is said of an entry."""
        return await self.converse(address, coeinfo_client.entry_description(index, subindex))

    async def foe_read(
        self, address: int, name: str, *, password: int = 0, progress: Progress | None = None
    ) -> bytes:
        """Read a file."""
        content = io.BytesIO()
        sizes = await self.sizes_of(address)
        talk = foe_client.read(name, content.write, sizes, password=password, progress=progress)
        await self.converse(address, talk)
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
        talk = foe_client.write(name, source, sizes, password=password, progress=progress)
        await self.converse(address, talk)

    async def idn_read(
        self, address: int, idn: Idn, elements: int = Element.VALUE, *, drive: int = 0
    ) -> bytes:
        """Read elements of an IDN, one behind the other."""
        return await self.converse(address, soe_client.read(idn, elements, drive=drive))

    async def idn_describe(self, address: int, idn: Idn, *, drive: int = 0) -> IdnDescription:
        """Read all elements of an IDN in one view."""
        return await self.converse(address, soe_browse.describe(idn, drive=drive))

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
        talk = soe_client.write(idn, data, sizes, elements=element, drive=drive)
        await self.converse(address, talk)

    async def voe(self, address: int, vendor_id: int, vendor_type: int, data: bytes) -> bytes:
        """Send data of a vendor's protocol; return the data of its answer."""
        return await self.converse(address, voe_client.exchange(vendor_id, vendor_type, data))

    async def slaves(self) -> list[MasterSlave]:
        """Return the slaves that the master knows."""
        return await self.converse(0, read_slaves())

    async def sizes_of(self, address: int) -> MailboxSizes:
        """Return the mailboxes of a slave; raises as :meth:`GatewayClient.sizes_of`."""
        if known := self.mailboxes.get(address):
            return known
        try:
            return sizes_of(await self.slaves(), address)
        except NOT_TOLD as exc:
            exc.add_note(not_told(address))
            raise

    async def _sizes_or_default(self, address: int) -> MailboxSizes:
        """Return the mailboxes of a slave, for messages that may as well be shorter."""
        if self._master_tells:
            with suppress(*NOT_TOLD):
                return await self.sizes_of(address)
            self._master_tells = False  # each question would wait for as long
        return self.mailboxes.get(address, MailboxSizes())

    async def converse(self, address: int, conversation: Conversation[T]) -> T:
        """Lead any conversation."""
        dialogue = Dialogue(conversation, address, self._counter)
        try:
            with self._protocol.listening() as frames:
                while not dialogue.is_done:
                    await self._step(dialogue, frames)
        finally:
            farewell = dialogue.close()
            self._counter = dialogue.counter
            if farewell is not None:
                self._protocol.send(farewell)
        return dialogue.result()

    async def _step(self, dialogue: Dialogue[T], frames: asyncio.Queue[bytes]) -> None:
        if dialogue.delay_ns:
            await asyncio.sleep(dialogue.delay_ns / _S)
        for _ in range(self._tries):
            if dialogue.frame is not None:
                self._protocol.send(dialogue.frame)
                if not dialogue.expects_reply:
                    dialogue.sent()
                    return
            try:
                async with asyncio.timeout(self._timeout_s):
                    while not dialogue.receive(await frames.get()):
                        pass
            except TimeoutError:
                continue
            return
        host, port = self._place
        dialogue.expire(f"gateway {host}:{port} {patience(self._timeout_s, self._tries, 'UDP')}")


class _Datagrams(asyncio.DatagramProtocol):
    """Hands each datagram to all who listen: who asked knows his answer."""

    def __init__(self) -> None:
        self._transport: asyncio.DatagramTransport | None = None
        self._queues: list[asyncio.Queue[bytes]] = []

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Keep the way to send."""
        # No instance of DatagramTransport, though it has all its methods (Python 3.11).
        self._transport = cast("asyncio.DatagramTransport", transport)

    def datagram_received(self, data: bytes, addr: object) -> None:
        """Hand a datagram on."""
        for queue in self._queues:
            queue.put_nowait(data)

    def listening(self) -> _Listening:
        """Listen for the length of a block."""
        return _Listening(self._queues)

    def send(self, frame: bytes) -> None:
        """Send a datagram."""
        if self._transport is not None:
            self._transport.sendto(frame)

    def close(self) -> None:
        """Let go of the socket."""
        if self._transport is not None:
            self._transport.close()


class _Listening:
    def __init__(self, queues: list[asyncio.Queue[bytes]]) -> None:
        self._queues = queues
        self._own: asyncio.Queue[bytes] = asyncio.Queue()

    def __enter__(self) -> asyncio.Queue[bytes]:
        self._queues.append(self._own)
        return self._own

    def __exit__(self, *about: object) -> None:
        self._queues.remove(self._own)
