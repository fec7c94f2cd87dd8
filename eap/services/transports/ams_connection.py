"""One AMS/TCP connection, accepted or opened: received and sent packets (Beckhoff ADS, AMS/TCP).

Rule 1: requests are forwarded as they come, and answered in any order.  Reading pauses while too
many of them are pending, or while the peer does not read its answers.
Rule 2: after a few packets other connections have their turn, however many more are buffered.
Rule 3: a connection that this side opened is always read: it mostly receives answers, and two
stations that both wait for the other to read would deadlock.
Rule 4: the name of a connection is unique: clients of one host share its NetID, and often ports and
invoke ids too.
Rule 5: a client that requests an AMS address, as local clients of a TwinCAT router do, gets one
that no station and no other client has.  Answers return by the connection, so the router keeps no
record of the address.
"""

from __future__ import annotations

import asyncio
import itertools
import logging
import struct
from collections.abc import Callable, Iterable
from time import monotonic_ns
from typing import ClassVar, Protocol

import msgspec

from eap.ams.reassembly import (
    AmsStreamDecoder,
    BareAmsDecoder,
    OversizedPacket,
    RouterRequest,
    StreamItem,
)
from eap.codec.ads import AdsError, IndexGroup
from eap.codec.ams import (
    AmsAnswer,
    AmsCommand,
    AmsHeader,
    RouterCommand,
    StateFlags,
    encode_net_id,
    encode_opened_port,
    encode_with_prefix,
    response_to,
)
from eap.errors import MalformedError
from eap.ids import NetId
from eap.net.limits import Activity, CloseReason
from eap.runtime.drop_counters import DropReason

MAX_REQUESTS = 64
"""Limit of the pending requests of one connection."""
MAX_OCTETS = 256 << 10
"""Limit of the bytes of these requests and of the requested answers; a single request may exceed
it."""
_COMMAND, _COMMAND_GROUP, _FLAGS = 16, 17, 18
"""Offsets in the AMS header: both bytes of the command, and the lower one of the state flags."""
_ERROR = slice(24, 28)
_RESULT = slice(AmsHeader.SIZE, AmsHeader.SIZE + 4)
_LENGTH = struct.Struct("<8xI")
_WITHOUT_ANSWER = (StateFlags.RESPONSE | StateFlags.NO_RETURN).value
_RESPONSE = StateFlags.RESPONSE.value
_NOTIFICATION = AmsCommand.NOTIFICATION.value
_READS = frozenset((AmsCommand.READ.value, AmsCommand.READ_WRITE.value))
_ADD, _DELETE = AmsCommand.ADD_NOTIFICATION.value, AmsCommand.DELETE_NOTIFICATION.value
_ABOUT_NOTIFICATIONS = frozenset((_ADD, _DELETE))
_READ_WRITE = AmsCommand.READ_WRITE.value
_GROUP = slice(AmsHeader.SIZE, AmsHeader.SIZE + 4)
_SUM_ITEMS = AmsHeader.SIZE + 8
"""Offset of the items in the answer to a sum command, behind its result and length."""
_SUM_ADD = IndexGroup.SUM_ADD_NOTIFICATION.value.to_bytes(4, "little")
_SUM_DELETE = IndexGroup.SUM_DELETE_NOTIFICATION.value.to_bytes(4, "little")
_ITEM_SIZES = {_SUM_ADD: 8, _SUM_DELETE: 4}
"""Bytes of one item: a result, and a handle where a notification was added."""
_INVOKE_ID = slice(28, 32)
_MAX_SUMS = 256
_NO_ERROR = bytes(4)


class SubscriptionCounter:
    """Number of notifications of one connection, counted from its answers.

    Attributes:
        count: Granted by an answer and not ended by a later one.
    """

    __slots__ = ("_sums", "count")

    def __init__(self) -> None:
        self.count = 0
        self._sums: dict[bytes, bytes] = {}
        """Index groups of the pending sum commands, which their answers do not repeat."""

    def note_request(self, packet: bytes) -> None:
        """Note a received request."""
        group = packet[_GROUP]
        if group in _ITEM_SIZES and packet[_COMMAND] == _READ_WRITE and len(self._sums) < _MAX_SUMS:
            # The connection may carry requests of several clients: both addresses and the id.
            self._sums[packet[:16] + packet[_INVOKE_ID]] = group

    def note_answer(self, packet: bytes) -> None:
        """Note a sent answer."""
        command = packet[_COMMAND]
        if command in _ABOUT_NOTIFICATIONS:
            count = int(_is_granted(packet))
            self._add(count if command == _ADD else -count)
        elif command == _READ_WRITE and self._sums:
            # An answer has the addresses of its request swapped.
            key = packet[8:16] + packet[:8] + packet[_INVOKE_ID]
            group = self._sums.pop(key, b"")
            if group and _is_granted(packet):
                starts = range(_SUM_ITEMS, len(packet) - 3, _ITEM_SIZES[group])
                count = sum(packet[at : at + 4] == _NO_ERROR for at in starts)
                self._add(count if group == _SUM_ADD else -count)

    def _add(self, count: int) -> None:
        self.count = max(0, self.count + count)


class AmsWindow:
    """Pending requests and bytes of one connection.

    Attributes:
        requests: Number of pending requests.
        subscriptions: Notifications of the connection.
    """

    __slots__ = ("_octets", "requests", "subscriptions")

    def __init__(self) -> None:
        self.requests = 0
        self.subscriptions = SubscriptionCounter()
        self._octets = 0

    @property
    def is_full(self) -> bool:
        """True if the next request has to wait."""
        return self.requests >= MAX_REQUESTS or self._octets >= MAX_OCTETS

    def note_incoming(self, packet: bytes) -> bool:
        """Note a received packet; return whether it is an answer."""
        flags, command = packet[_FLAGS], packet[_COMMAND]
        # A command of another group is a fragment, which has no answer.
        if flags & _WITHOUT_ANSWER or packet[_COMMAND_GROUP] or command == _NOTIFICATION:
            return bool(flags & _RESPONSE)
        size = len(packet)
        self.requests += 1
        self._octets += size
        if command in _READS and size >= AmsHeader.SIZE + _LENGTH.size:
            (requested,) = _LENGTH.unpack_from(packet, AmsHeader.SIZE)
            # A client may ask for any length: it counts as a full window at most.
            self._octets += min(MAX_OCTETS, requested)
            if packet[_GROUP] in _ITEM_SIZES:
                self.subscriptions.note_request(packet)
        return False

    def note_outgoing(self, packet: bytes) -> bool:
        """Note a sent packet; return whether it answers a received one."""
        if not packet[_FLAGS] & _RESPONSE or packet[_COMMAND_GROUP] or not self.requests:
            return False
        # Answers come in any order and do not repeat the size of their requests.  The average is
        # near enough, and reaches 0 with the last answer.
        self._octets -= self._octets // self.requests
        self.requests -= 1
        self.subscriptions.note_answer(packet)
        return True


def _is_granted(answer: bytes) -> bool:
    return answer[_ERROR] == answer[_RESULT] == _NO_ERROR


# No value here is a quarter as long.
LONGEST_PACKET = 256 << 10
"""Limit of the bytes of an AMS packet."""
LONGEST_ANSWER = 4 << 20
"""Likewise on a connection that this side opened: the symbols of a large controller."""
# The pending requests keep a client below, unless it does not keep up with its notifications.
MAX_UNSENT = 8 << 20
"""Limit of the bytes that a peer has not read."""
# The default of asyncio allocates and frees 256 KB for each packet, which takes longer than
# everything else.
_RECEIVED = memoryview(bytearray(64 << 10))
"""Receive buffer of all connections."""
_PER_TURN = 8
"""Packets of one connection in a row, while few connections have more."""
_FEW = 4
"""With more connections than these that have more packets, each gets one packet in a row."""
_FIRST_PORT, _LAST_PORT = 32768, 40959
"""AMS ports for clients that request one, as a TwinCAT router numbers them."""
_FIRST_SUFFIX, _LAST_SUFFIX = 0x8001, 0xFEFE
"""Last two bytes of the NetIDs for these clients; stations have .1.1, .2.1 and so on."""
_NO_RETURN = StateFlags.NO_RETURN.value  # a plain number: operators of flags are slow

logger = logging.getLogger(__name__)


class PacketHandler(Protocol):
    """User of a connection, which handles its packets."""

    def connection_opened(self, connection: AmsConnection) -> None:
        """Begin to use *connection* for sending."""

    def handle_packet(self, packet: bytes, connection: AmsConnection) -> None:
        """Handle a request with a valid length; its answer returns by *connection*."""

    def handle_answer(self, packet: bytes, connection: AmsConnection) -> None:
        """Handle an answer."""

    def connection_closed(self, connection: AmsConnection, why: str) -> None:
        """Stop using *connection*; *why* is for people."""

    def count_dropped(self, reason: DropReason) -> None:
        """Count a dropped packet or connection."""


class ClientAddresses:
    """AMS addresses for clients that request one, unlike those of stations and other clients.

    The first four bytes are those of the client's IP address, as access rules expect them.

    Args:
        first: Number of the first address.  A different one in each process makes it unlikely that
            two routers assign the same address to two clients of one host.
    """

    def __init__(self, first: int) -> None:
        self._numbers = itertools.count(first)

    def next(self, host: str, taken: Callable[[NetId], bool]) -> tuple[NetId, int]:
        """Return the next address for a client on *host* whose NetID is not *taken*."""
        while True:
            number = next(self._numbers)
            suffix = _FIRST_SUFFIX + number % (_LAST_SUFFIX - _FIRST_SUFFIX + 1)
            high, low = divmod(suffix, 0x100)
            # Only the last two bytes vary, so the rules for the client's network still match.
            net_id = NetId.parse(f"{host}.{high}.{low}")
            if not taken(net_id):
                return net_id, _FIRST_PORT + number % (_LAST_PORT - _FIRST_PORT + 1)


class AmsConnection(asyncio.BufferedProtocol):
    """One connection.

    Args:
        name: Unique name.
        address: IP address of the peer.
        handler: Handles its packets.
        is_outgoing: Whether this side opened it.
        assign_address: Returns NetID and port for a client on a host that requests an AMS address;
            without it a request for one ends the connection.
        host: Host that the policy counts it for (:mod:`eap.net.limits`).

    Attributes:
        name: As above.
        host: As above.
        used_at_ns: Time of the latest packet.
        late_since_ns: Since when a packet is incomplete, or answers are not read; None otherwise.
        closed: Completed with the reason when the connection has ended.
    """

    _busy_count: ClassVar[int] = 0
    """Number of connections of this process with more packets."""
    _make_decoder: ClassVar[type[AmsStreamDecoder | BareAmsDecoder]] = AmsStreamDecoder

    def __init__(
        self,
        name: str,
        address: str,
        handler: PacketHandler,
        *,
        is_outgoing: bool = False,
        assign_address: Callable[[str], tuple[NetId, int]] | None = None,
        host: str = "",
    ) -> None:
        self.name = name
        self.host = host
        self.used_at_ns = monotonic_ns()
        self.late_since_ns: int | None = None
        self.closed: asyncio.Future[str] = asyncio.get_running_loop().create_future()
        self._address = address
        self._is_used = False
        self._handler = handler
        self._is_outgoing = is_outgoing
        self._window = AmsWindow()
        self._cutter = self._make_decoder(LONGEST_ANSWER if is_outgoing else LONGEST_PACKET)
        self._transport: asyncio.Transport
        self._is_open = False
        self._is_paused = False
        self._is_scheduled = False
        self._is_blocked = False
        self._is_half_closed = False
        self._why = "closed by the peer"
        self._assign_address = assign_address
        self._net_id: NetId | None = None
        self._is_closed = False

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Open the connection (asyncio)."""
        assert isinstance(transport, asyncio.Transport)  # noqa: S101  for the type
        self._transport = transport
        self._is_open = True
        self._handler.connection_opened(self)
        if self._is_closed:
            transport.abort()

    def get_buffer(self, sizehint: int) -> memoryview:
        """Return the receive buffer; it is emptied before another connection receives (asyncio)."""
        del sizehint
        return _RECEIVED

    def buffer_updated(self, nbytes: int) -> None:
        """Handle received bytes (asyncio)."""
        if self._is_outgoing and not self._is_blocked:
            # An answer of 4 MB takes longer than 10 s on a slow link: its latest byte counts.
            self.late_since_ns = None
        packet = self._cutter.receive_one(bytes(_RECEIVED[:nbytes]))
        if packet is None:
            self._handle_buffered()
        else:
            self._handle(packet)
            if not self._is_outgoing and (self._is_blocked or self._window.is_full):
                self._pause_reading()

    def eof_received(self) -> bool:
        """Note the end of the received data; the peer may still read answers (asyncio)."""
        self._is_half_closed = True
        # True keeps the transport open: asyncio would close it otherwise, with answers still
        # pending.
        self._close_when_done()
        return True

    def pause_writing(self) -> None:
        """Pause reading while the peer does not read (asyncio)."""
        self._is_blocked = True
        self.late_since_ns = monotonic_ns()
        if not self._is_outgoing:
            self._pause_reading()

    def resume_writing(self) -> None:
        """Resume reading (asyncio)."""
        self._is_blocked = False
        self.late_since_ns = None
        self._schedule()

    def connection_lost(self, exc: Exception | None) -> None:
        """End the connection (asyncio)."""
        if isinstance(exc, OSError) and exc.strerror:
            self._why = exc.strerror
        self._handler.connection_closed(self, self._why)
        if not self.closed.done():
            self.closed.set_result(self._why)

    def send(self, packets: Iterable[bytes]) -> str | None:
        """Send packets; return the reason if that is impossible."""
        transport = self._transport
        if transport.is_closing():
            return "the connection was closed"
        # pause_writing() alone bounds nothing: notifications come without requests.
        if self._is_blocked and transport.get_write_buffer_size() > MAX_UNSENT:
            if not self._is_outgoing:
                self.close(CloseReason.OVERDUE)
            return "the peer does not read"
        for packet in packets:
            transport.write(self._framed(packet))
            if self._window.note_outgoing(packet) and (self._is_paused or self._is_half_closed):
                self._schedule()
        return None

    @property
    def activity(self) -> Activity:
        """Current use, for the policy."""
        if self._window.subscriptions.count:
            return Activity.SUBSCRIBED
        if self._window.requests:
            return Activity.BUSY
        return Activity.IDLE if self._is_used else Activity.UNUSED

    def close(self, why: str) -> None:
        """Close it at once, even before it is open; the handler gets the reason *why*."""
        if why is CloseReason.OVERDUE and not self._is_half_closed:
            self._handler.count_dropped(DropReason.AMS_SLOW)
        self._why = why
        self._is_closed = True
        if self._is_open:
            self._transport.abort()

    def _framed(self, packet: bytes) -> bytes:
        """Return a packet as the stream has it."""
        return encode_with_prefix(packet)

    def _schedule(self) -> None:
        if not self._is_scheduled:
            self._is_scheduled = True
            AmsConnection._busy_count += 1
            asyncio.get_running_loop().call_soon(self._handle_buffered)

    def _pause_reading(self) -> None:
        if not self._is_paused:
            self._is_paused = True
            self._transport.pause_reading()
        if not self._is_blocked:
            self.late_since_ns = None  # an incomplete packet waits here, not at the peer

    def _handle_buffered(self) -> None:
        """Handle some of the buffered packets, and resume reading after the last one."""
        if self._is_scheduled:
            self._is_scheduled = False
            AmsConnection._busy_count -= 1
        for _ in range(_PER_TURN if AmsConnection._busy_count <= _FEW else 1):
            if self._transport.is_closing():
                return
            if not self._is_outgoing and (self._is_blocked or self._window.is_full):
                self._pause_reading()
                return
            try:
                piece = self._cutter.next_item()
            except MalformedError as exc:
                self._reject_stream(str(exc))
                return
            if piece is None:
                self._resume_reading()
                return
            self._handle(piece)
        self._pause_reading()
        self._schedule()

    def _resume_reading(self) -> None:
        if self._is_half_closed:
            self._close_when_done()
            return
        if self._is_paused:
            self._is_paused = False
            self._transport.resume_reading()
        if self._cutter.has_begun and self.late_since_ns is None:
            self.late_since_ns = monotonic_ns()

    def _reject_stream(self, why: str) -> None:
        """Stop reading, because these are no AMS packets."""
        logger.debug("AMS/TCP connection %s closed: %s", self.name, why)
        self._handler.count_dropped(DropReason.AMS_TYPE)
        self._why = f"no AMS packets: {why}"
        self._cutter = self._make_decoder(0)
        self._is_half_closed = True
        self._pause_reading()
        self._close_when_done()

    def _close_when_done(self) -> None:
        if self._is_outgoing or not (self._window.requests or self._is_scheduled):
            self._transport.close()
            if self.late_since_ns is None:
                self.late_since_ns = monotonic_ns()  # the peer may not have read all answers

    def _handle(self, piece: StreamItem) -> None:
        self.used_at_ns = monotonic_ns()
        self._is_used = True
        if not self._is_blocked:
            self.late_since_ns = None
        if isinstance(piece, OversizedPacket):
            self._refuse_length(piece.header)
        elif isinstance(piece, RouterRequest):
            self._answer_client(piece)
        elif int.from_bytes(piece[20:24], "little") != len(piece) - AmsHeader.SIZE:
            self._refuse_length(AmsHeader.decode(piece))
        elif self._window.note_incoming(piece):
            self._handler.handle_answer(piece, self)
        else:
            self._handler.handle_packet(piece, self)

    def _answer_client(self, request: RouterRequest) -> None:
        port = int.from_bytes(request.data, "little")
        if self._assign_address is None:
            self._reject_stream("a router requests an address")
            return
        net_id, own_port = self._assign_address(self._address)
        self._net_id = net_id = self._net_id or net_id
        if request.command is RouterCommand.NET_ID:
            self._transport.write(encode_net_id(net_id))
        elif request.command is RouterCommand.CLOSE_PORT:
            self._why = "the client closed its port"
            self._is_half_closed = True
            self._close_when_done()
        # Port 0 requests any port; with another one the client would be a server.
        elif port:
            self._reject_stream(f"a client cannot serve AMS port {port}")
        else:
            self._transport.write(encode_opened_port(net_id, own_port))

    def _refuse_length(self, header: AmsHeader) -> None:
        self._handler.count_dropped(DropReason.AMS_LENGTH)
        if header.state_flags & StateFlags.RESPONSE:
            # The client of this answer need not wait for its time-out.
            answer = msgspec.structs.replace(header, length=0, error_code=AdsError.AMS_LENGTH)
            self._handler.handle_answer(answer.encode(), self)
        elif not header.state_flags & _NO_RETURN and header.command != AmsCommand.NOTIFICATION:
            refusal = response_to(header, AmsAnswer(error_code=AdsError.AMS_LENGTH))
            self._transport.write(self._framed(refusal))
