"""Client of any mailbox gateway (ETG.8200), blocking or asynchronous, over UDP or TCP.

    with GatewayClient("10.0.0.5") as gateway:
        vendor = gateway.sdo_read(1001, 0x1018, 1)
        gateway.foe_write(1001, "firmware.bin", Path("new.bin").read_bytes())

Address 0 is the master itself, 1001 usually the first slave.  Where a message may not fit, the
mailbox of a slave is looked up in the master's dictionary; for objects and IDNs 128 bytes will do
if there is none.  A refusal raises SdoAbortError, SoeError, FoeError or MailboxRefusedError, and
silence MailboxTimeoutError.
"""

from __future__ import annotations

import asyncio
import io
import select
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from time import monotonic_ns
from types import TracebackType
from typing import Self, TypeVar, cast

from devicebus.errors import BusError
from devicebus.mailbox import coe_client, foe_client, soe_client, voe
from devicebus.mailbox.conversation import (
    Conversation,
    MailboxMessage,
    MailboxRequest,
    Progress,
    drive,
    drive_async,
)
from devicebus.mailbox.protocol import MailboxSizes
from devicebus.mailbox.soe_client import IdnDescription
from eap.closeable import Closeable
from eap.codec.coe import EXPEDITED_SIZE, EntryDescription, ObjectDescription
from eap.codec.ethercat import EtherCatHeader
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
_S, _MS = 1_000_000_000, 1_000_000
_LARGEST = 4096


def _silence(duration_s: float, transport: str) -> str:
    """Return the text for a gateway that did not answer."""
    return (
        f"was silent for {duration_s:g} s; is it started, and does a firewall let {transport}"
        " through?"
    )


class GatewayClient(Closeable):
    """A blocking client.

    Args:
        host: Name or address of the gateway.
        port: Its port.
        tcp: Whether to connect by TCP instead of sending datagrams.
        timeout_s: How long an answer may take before the request is sent again.
        tries: How often a datagram is sent; by TCP the client waits as long in all.

    Attributes:
        mailboxes: Sizes that need not be asked for, by address; a master's dictionary has none of
            virtual addresses.

    Raises:
        EnvironmentalError: the host has no address, or no route leads there.
        BusError: the host accepts no connection.
    """

    def __init__(
        self,
        host: str,
        port: int = PORT,
        *,
        tcp: bool = False,
        timeout_s: float = TIMEOUT_S,
        tries: int = TRIES,
    ) -> None:
        self.mailboxes: dict[int, MailboxSizes] = {}
        self._has_dictionary = True
        self._is_stream = tcp
        self._rest = b""
        kind = socket.SOCK_STREAM if tcp else socket.SOCK_DGRAM
        self._label = f"gateway {host}:{port}"
        self._conversations = GatewayConversations(
            # TCP repeats lost data by itself: one request waits as long as all tries of a datagram.
            timeout_ns=round(timeout_s * (tries if tcp else 1) * _S),
            tries=1 if tcp else tries,
            silence=f"{self._label} {_silence(timeout_s * tries, 'TCP' if tcp else 'UDP')}",
        )
        self._socket = socket.socket(socket.AF_INET, kind)
        self._socket.settimeout(timeout_s * tries if tcp else timeout_s)
        try:
            self._socket.connect((host, port))
        except (ConnectionError, TimeoutError) as exc:
            self._socket.close()
            raise self._failure(exc) from None
        except OSError as exc:
            self._socket.close()
            raise EnvironmentalError(f"{self._label}: {exc.strerror or exc}") from None
        except TypeError:  # as sockets put it
            self._socket.close()
            raise EnvironmentalError(f"{self._label}: it is no name of a host") from None
        self._readable = select.poll()
        self._readable.register(self._socket, select.POLLIN)

    def close(self) -> None:
        """Let go of the socket."""
        self._socket.close()

    @contextmanager
    def waiting_once(self, timeout_s: float) -> Iterator[None]:
        """Send each request once and wait so long for its answer, for the length of a block."""
        core = self._conversations
        before = core.tries, core.timeout_ns
        core.tries, core.timeout_ns = 1, round(timeout_s * _S)
        try:
            yield
        finally:
            core.tries, core.timeout_ns = before

    def sdo_read(
        self, address: int, index: int, subindex: int = 0, *, complete: bool = False
    ) -> bytes:
        """Read an entry, or with *complete* a whole object."""
        return self.converse(address, coe_client.upload(index, subindex, complete=complete))

    def sdo_write(
        self, address: int, index: int, subindex: int, data: bytes, *, complete: bool = False
    ) -> None:
        """Write an entry, or with *complete* a whole object."""
        sizes = self._sizes_or_default(address) if len(data) > EXPEDITED_SIZE else MailboxSizes()
        conversation = coe_client.download(index, subindex, data, sizes, complete=complete)
        self.converse(address, conversation)

    def od_list(self, address: int) -> list[int]:
        """Read the indexes of all objects."""
        return self.converse(address, coe_client.object_list())

    def od_object(self, address: int, index: int) -> ObjectDescription:
        """Read the description of an object."""
        return self.converse(address, coe_client.object_description(index))

    def od_entry(self, address: int, index: int, subindex: int) -> EntryDescription:
        """Read the description of an entry."""
        return self.converse(address, coe_client.entry_description(index, subindex))

    def idn_read(
        self, address: int, idn: Idn, elements: int = Element.VALUE, *, drive: int = 0
    ) -> bytes:
        """Read elements of an IDN, one behind the other."""
        return self.converse(address, soe_client.read(idn, elements, drive=drive))

    def idn_describe(self, address: int, idn: Idn, *, drive: int = 0) -> IdnDescription:
        """Read all elements of an IDN in one view."""
        return self.converse(address, soe_client.describe(idn, drive=drive))

    def idn_write(
        self,
        address: int,
        idn: Idn,
        data: bytes,
        *,
        element: int = Element.VALUE,
        drive: int = 0,
    ) -> None:
        """Write an element of an IDN; a list or text with its head."""
        sizes = self._sizes_or_default(address)
        conversation = soe_client.write(idn, data, sizes, elements=element, drive=drive)
        self.converse(address, conversation)

    def foe_read(
        self, address: int, name: str, *, password: int = 0, progress: Progress | None = None
    ) -> bytes:
        """Read a file."""
        content = io.BytesIO()
        sizes = self.sizes_of(address)
        conversation = foe_client.read(
            name, content.write, sizes, password=password, progress=progress
        )
        self.converse(address, conversation)
        return content.getvalue()

    def foe_write(
        self,
        address: int,
        name: str,
        data: bytes,
        *,
        password: int = 0,
        progress: Progress | None = None,
    ) -> None:
        """Write a file."""
        sizes = self.sizes_of(address)
        source = io.BytesIO(data).read
        conversation = foe_client.write(name, source, sizes, password=password, progress=progress)
        self.converse(address, conversation)

    def voe(self, address: int, vendor_id: int, vendor_type: int, data: bytes) -> bytes:
        """Send data of a vendor's protocol; return the data of its answer."""
        return self.converse(address, voe.exchange(vendor_id, vendor_type, data))

    def slaves(self) -> list[MasterSlave]:
        """Return the slaves that the master knows."""
        return self.converse(0, read_slaves())

    def sizes_of(self, address: int) -> MailboxSizes:
        """Return the mailboxes of a slave, as the master's dictionary has them.

        Raises:
            BusError: the master knows no such slave, or the slave has no mailbox.
            MailboxTimeoutError, MailboxRefusedError, SdoAbortError: the master has no dictionary.
        """
        return self.mailboxes.get(address) or self.converse(0, read_sizes(address))

    def _sizes_or_default(self, address: int) -> MailboxSizes:
        """Return the mailboxes of a slave, for messages that may as well be shorter."""
        if self._has_dictionary:
            with suppress(*NO_DICTIONARY):
                return self.sizes_of(address)
            self._has_dictionary = False  # each question would wait for as long
        return self.mailboxes.get(address, MailboxSizes())

    def converse(
        self,
        address: int,
        conversation: Conversation[T],
        meanwhile: Callable[[], None] | None = None,
    ) -> T:
        """Run any conversation; *meanwhile* is called after each step."""
        place = GatewayConversation(address)
        try:
            return drive(conversation, partial(self._exchange, place, meanwhile))
        finally:
            self._conversations.close(place, monotonic_ns())
            with suppress(BusError):
                self._send_frames()

    def _exchange(
        self, place: GatewayConversation, meanwhile: Callable[[], None] | None, ask: MailboxRequest
    ) -> MailboxMessage:
        core = self._conversations
        while (octets := self._receive(0)) is not None:  # late ones, which must not answer this
            core.receive_frame(octets, monotonic_ns())
        request = core.request(place, ask, monotonic_ns())
        self._send_frames()
        while not request.is_done:
            octets = self._receive(core.next_timeout() or 0)
            if octets is None:
                core.handle_timeout(monotonic_ns())
            else:
                core.receive_frame(octets, monotonic_ns())
            self._send_frames()
        while core.next_event() is not None:
            pass  # the only one is this request
        if meanwhile is not None:
            meanwhile()
        return request.result()

    def _send_frames(self) -> None:
        try:
            for frame in self._conversations.frames_to_send(monotonic_ns()):
                self._socket.sendall(frame)
        except OSError as exc:
            raise self._failure(exc) from None

    def _receive(self, deadline_ns: int) -> bytes | None:
        """Return the next frame, None if there is none until *deadline_ns*."""
        while True:
            if self._is_stream:
                frame, self._rest = cut_frame(self._rest)
                if frame is not None:
                    return frame
            wait_ns = deadline_ns - monotonic_ns() if deadline_ns else 0
            if not self._readable.poll(max(0, -(-wait_ns // _MS))):
                return None
            try:
                octets = self._socket.recv(_LARGEST)
            except TimeoutError:
                return None  # a datagram whose checksum was wrong
            except OSError as exc:
                raise self._failure(exc) from None
            if not self._is_stream:
                return octets
            if not octets:
                raise BusError(f"{self._label} has closed the connection")
            self._rest += octets

    def _failure(self, error: OSError) -> BusError:
        hint = ": no gateway listens there" if isinstance(error, ConnectionRefusedError) else ""
        return BusError(f"{self._label} does not answer: {error.strerror or error}{hint}")


def cut_frame(octets: bytes) -> tuple[bytes | None, bytes]:
    """Return the first whole frame of a stream, None if there is none yet, and the rest."""
    if len(octets) < EtherCatHeader.SIZE:
        return None, octets
    # On TCP frames follow each other with nothing between: their Length alone delimits them.
    end = EtherCatHeader.SIZE + EtherCatHeader.decode(octets).length
    return (octets[:end], octets[end:]) if len(octets) >= end else (None, octets)


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
                silence=f"gateway {host}:{port} {_silence(timeout_s * tries, 'UDP')}",
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
