"""Frames of type 5 on UDP and Ethernet: intake, framing, and MAC addresses of NetIDs.

AoE to address 0 is for the router of a station; every other mailbox belongs to a bus, whose gateway
forwards it.  A frame that nothing accepts is counted under its reason.  A frame that waited in a
socket since before this process started is stale: the request of its sender has timed out.

A NetID on an Ethernet segment is resolved to a MAC address as ARP does it, with AoE (own format):
a ReadState goes to the multicast address of EAP, only the port with that NetID answers, and the
answer carries its address.  The query is repeated from time to time, because devices are exchanged.
"""

from __future__ import annotations

import asyncio
from collections import OrderedDict
from collections.abc import Callable, Sequence
from contextlib import suppress
from time import monotonic_ns
from typing import NamedTuple, Protocol, TypeAlias

from devicebus.mailbox.conversation import next_counter
from eap.ams.hop_prober import PROBE_PORT
from eap.codec.ams import DEVICE_PORT, AmsCommand, AmsHeader, StateFlags
from eap.codec.ethercat import EtherCatHeader, FrameType
from eap.codec.mailbox import (
    MailboxHeader,
    MailboxType,
    aoe_packet_in,
    decode_frame,
    encode_plain_frame,
)
from eap.codec.wire import Buffer
from eap.errors import CodecError, MalformedError
from eap.ids import EAP_MULTICAST_MAC, MacAddr, NetId
from eap.net.busypoll import BusyPollLoop
from eap.pd.link import FrameChannel, FrameOrigin, OutFrame
from eap.runtime.drop_counters import DropCounters, DropReason
from eap.services.transports.demultiplexer import Demultiplexer

_MAILBOX = FrameType.MAILBOX.value  # a plain number: members of enums are slow


class DrainedChannel(Protocol):
    """UDP or Ethernet channel, as services use it."""

    def drain(self, now_ns: int) -> int:
        """Pass the waiting frames to the takers; return their number."""

    def fileno(self) -> int:
        """Return the descriptor to watch."""


MailboxHandler: TypeAlias = Callable[[memoryview, int, int, FrameOrigin], DropReason | None]
"""Handles a frame of type 5; returns the reason if it is dropped."""


class FrameIntake:
    """Sorts the frames of one socket by type, for the stations that listen there.

    Args:
        stations: Stations at which dropped frames are counted.
        counters: The counters.
        from_ns: Start of this process, on the monotonic clock.
        mailbox: Handles type 5.
    """

    def __init__(
        self,
        stations: Sequence[str],
        counters: DropCounters,
        from_ns: int,
        mailbox: MailboxHandler,
    ) -> None:
        self._stations = stations
        self._counters = counters
        self._from_ns = from_ns
        self.mailbox = mailbox

    def receive(self, data: memoryview, size: int, at_ns: int, origin: FrameOrigin) -> None:
        """Handle, or count, one frame that arrived at *at_ns* on the monotonic clock."""
        # The timestamp of the kernel, because the socket outlives this process.
        if at_ns < self._from_ns:
            reason: DropReason | None = DropReason.STALE
        elif size < EtherCatHeader.SIZE:
            reason = DropReason.TRUNCATED
        elif data[1] >> 4 == _MAILBOX:  # the four upper bits of the header
            reason = self.mailbox(data, size, at_ns, origin)
        else:
            reason = DropReason.WRONG_TYPE
        if reason is not None:
            for station in self._stations:
                self._counters.count(station, reason)


class WithDescriptor(Protocol):
    """Object with a descriptor."""

    def fileno(self) -> int:
        """Return the descriptor."""


def watch_channel(channel: DrainedChannel) -> None:
    """Drain *channel* now and whenever something arrives, as long as the running loop lives."""

    def drain() -> int:
        return channel.drain(monotonic_ns())

    loop = asyncio.get_running_loop()
    watch = loop.watch if isinstance(loop, BusyPollLoop) else loop.add_reader
    watch(channel.fileno(), drain)
    drain()


def stop_watching(channel: WithDescriptor) -> None:
    """Drain *channel* no more, which is closed next; the loop may have ended."""
    with suppress(RuntimeError):
        loop = asyncio.get_running_loop()
        unwatch = loop.unwatch if isinstance(loop, BusyPollLoop) else loop.remove_reader
        unwatch(channel.fileno())


FRAME_OVERHEAD = EtherCatHeader.SIZE + MailboxHeader.SIZE
_MAX_PEERS = 1024


class FrameHandler(Protocol):
    """Handler of frames that are not AoE to a station: the gateways, if there are any."""

    @property
    def has_gateway(self) -> bool:
        """True if there is a gateway."""

    def receive(
        self, frame: bytes, connection: str, send: Callable[[str, bytes], object]
    ) -> DropReason | None:
        """Handle a frame of *connection*, answered by *send*; return the reason if dropped."""

    def connection_closed(self, connection: str) -> None:
        """Drop what belongs to a closed connection."""

    def waiting(self, connection: str) -> int:
        """Return the number of pending requests of a connection."""

    async def wait_below(self, connection: str, count: int) -> None:
        """Wait until fewer than *count* requests of a connection are pending."""


def aoe_packet(data: Buffer) -> bytes | None:
    """Return the AMS packet for a station in a frame of type 5, None if it has none."""
    packet = aoe_packet_in(data)
    return packet if packet is not None and len(packet) >= AmsHeader.SIZE else None


def refusal_of(data: Buffer) -> DropReason:
    """Return why a frame of type 5 is dropped that is for no station and no gateway."""
    try:
        decode_frame(data)
    except MalformedError:
        return DropReason.MAILBOX  # an unknown mailbox protocol
    except CodecError:
        return DropReason.TRUNCATED
    return DropReason.MAILBOX


class FrameCounters:
    """Mailbox counters of the frames to each peer, 1 to 7 in turn (ETG.1000.4, mailbox header).

    A receiver drops a frame with the counter of the previous one as repeated.  Received counters
    are not checked: requests have a sender and an invoke id, and simple clients send 1 only.
    """

    def __init__(self) -> None:
        self._latest: OrderedDict[str, int] = OrderedDict()

    def frame(self, peer: str, packet: bytes) -> bytes:
        """Return the frame of *packet* to *peer*."""
        # pop() moves the peer to the end, so that the first entry is the one unused for longest.
        counter = next_counter(self._latest.pop(peer, 0))
        self._latest[peer] = counter
        if len(self._latest) > _MAX_PEERS:
            self._latest.popitem(last=False)
        return encode_plain_frame(MailboxType.AOE, 0, counter, packet)


class PacketReceiver(Protocol):
    """Receiver of the packets of a channel."""

    def receive(self, data: bytes, connection: str, *, is_broadcast: bool = False) -> None:
        """Handle a packet from the address *connection*."""


class MailboxIntake:
    """Frames of type 5 of one channel, for the stations and gateways behind it.

    Args:
        demultiplexer: To the stations.
        gateway: For all but AoE to a station; a multicast frame goes to no gateway.
        sender: Sends the answers of the gateway.
        is_group_frame: Returns whether a frame is multicast.
        is_aoe_here: Whether AoE is for the stations; otherwise the gateway gets it too.
    """

    def __init__(
        self,
        demultiplexer: PacketReceiver,
        gateway: FrameHandler,
        sender: ChannelSender,
        is_group_frame: Callable[[memoryview], bool],
        *,
        is_aoe_here: bool = True,
    ) -> None:
        self._demultiplexer = demultiplexer
        self._gateway = gateway
        self._sender = sender
        self._is_for_many = is_group_frame
        self._is_aoe_here = is_aoe_here

    def receive(
        self, data: memoryview, size: int, at_ns: int, origin: FrameOrigin
    ) -> DropReason | None:
        """Handle a frame; return the reason if it is dropped."""
        del at_ns
        sender = origin.sender_of(data)
        if not sender:
            return DropReason.MAILBOX
        frame, is_group_frame = data[:size], self._is_for_many(data)
        packet = aoe_packet(frame) if self._is_aoe_here else None
        if packet is not None:
            self._demultiplexer.receive(packet, sender, is_broadcast=is_group_frame)
            return None
        # Several gateways get a multicast frame, and each would execute the request.
        if is_group_frame:
            return refusal_of(frame)
        return self._gateway.receive(bytes(frame), sender, self._sender.send_frame)

    def drop_reason(
        self, data: memoryview, size: int, at_ns: int, origin: FrameOrigin
    ) -> DropReason | None:
        """Return why a frame is dropped that another intake handles, without handling it."""
        del at_ns, origin
        if aoe_packet(data[:size]) is not None:
            return None
        reason = refusal_of(data[:size])
        is_taken = self._gateway.has_gateway and not self._is_for_many(data)
        return None if is_taken and reason is DropReason.MAILBOX else reason


class ChannelSender:
    """Sends packets in frames to the addresses that *channel* reaches."""

    def __init__(self, channel: FrameChannel) -> None:
        self._channel = channel
        self._counters = FrameCounters()

    def send(self, connection: str, packets: tuple[bytes, ...]) -> str | None:
        """Send packets to the address *connection*; return the reason of a failure."""
        return self._send(connection, [self._counters.frame(connection, each) for each in packets])

    def send_frame(self, connection: str, frame: bytes) -> str | None:
        """Send a frame of type 5; returns as :meth:`send` does."""
        return self._send(connection, [frame])

    def _send(self, connection: str, frames: Sequence[bytes]) -> str | None:
        header = self._channel.link_header(connection)
        sent = []
        for frame in frames:
            buffer = bytearray(header + frame)
            if len(buffer) < self._channel.minimum_size:
                # Ethernet pads short frames; the Length of the EtherCAT header tells the end.
                buffer += bytes(self._channel.minimum_size - len(buffer))
            sent.append(OutFrame(buffer, len(header), connection))
        failed = self._channel.send(sent, monotonic_ns())
        return "the network accepted no frame" if failed else None


QUERY_NS = 1_000_000_000
"""Time between two queries for a NetID without answer."""
QUERY_KNOWN_NS = 30_000_000_000
"""Time between two queries for a NetID with a known MAC address."""


class _Resolution(NamedTuple):
    mac: str
    """Empty while it is unknown."""
    asked_at_ns: int | None


class EthernetSegment:
    """Ethernet interface and VLAN, with the MAC addresses of NetIDs there.

    Args:
        demultiplexer: To the local stations on it.
        own_mac: Returns the own address, which changes with the interface.
    """

    def __init__(self, demultiplexer: Demultiplexer, own_mac: Callable[[], MacAddr]) -> None:
        self._own_mac = own_mac
        self._demultiplexer = demultiplexer
        self._resolutions: dict[NetId, _Resolution] = {}

    @property
    def mac(self) -> str:
        """Own address."""
        return str(self._own_mac())

    def forget(self) -> None:
        """Forget all addresses: the interface was made again, perhaps on another network."""
        self._resolutions.clear()

    def receive(self, data: bytes, connection: str, *, is_broadcast: bool = False) -> None:
        """Handle a packet; the arguments are those of :meth:`Demultiplexer.receive`."""
        self._learn(data, connection)
        self._demultiplexer.receive(data, connection, is_broadcast=is_broadcast)

    def find(self, net_id: NetId, now_ns: int, query: Callable[[], object]) -> str:
        """Return the MAC address of a NetID, empty while unknown; call *query* when it is due."""
        if self._demultiplexer.has(net_id):
            self._demultiplexer.set_hop_connection(str(net_id), self.mac)
            return self.mac
        place = self._resolutions.get(net_id, _Resolution("", None))
        pause_ns = QUERY_KNOWN_NS if place.mac else QUERY_NS
        if place.asked_at_ns is None or now_ns - place.asked_at_ns >= pause_ns:
            self._resolutions[net_id] = place._replace(asked_at_ns=now_ns)
            query()
        return place.mac

    def _learn(self, data: bytes, mac: str) -> None:
        if not self._resolutions:
            return
        try:
            header = AmsHeader.decode(data)
        except CodecError:
            return
        place = self._resolutions.get(header.source)
        # Only an answer to the own query is evidence of a MAC address.
        if place is None or header.target_port != PROBE_PORT or not _is_response(header):
            return
        if place.mac != mac and self._demultiplexer.has(header.target):
            self._resolutions[header.source] = place._replace(mac=mac)
            self._demultiplexer.set_hop_connection(str(header.source), mac)


class SegmentSender:
    """Sends packets of one station to MAC addresses, and to NetIDs of ports.

    Args:
        segment: Resolves the NetIDs.
        channel: Channel of the station's port.
        net_id: NetID of the station's router, the source of queries.
    """

    def __init__(self, segment: EthernetSegment, channel: FrameChannel, net_id: NetId) -> None:
        self._segment = segment
        self._sender = ChannelSender(channel)
        self._net_id = net_id

    def send(self, connection: str, packets: tuple[bytes, ...]) -> str | None:
        """Send packets to an address; return the reason of a failure."""
        mac = connection
        if ":" not in connection:
            net_id = NetId.parse(connection)
            mac = self._segment.find(net_id, monotonic_ns(), lambda: self._query(net_id))
        if not mac:
            return "its MAC address is not known yet"
        if mac != self._segment.mac:
            return self._sender.send(mac, packets)
        loop = asyncio.get_running_loop()
        for packet in packets:  # a packet socket does not receive frames of its own host
            loop.call_soon(self._segment.receive, packet, mac)
        return None

    def _query(self, net_id: NetId) -> None:
        question = AmsHeader(
            net_id, DEVICE_PORT, self._net_id, PROBE_PORT, AmsCommand.READ_STATE
        ).encode()
        self._sender.send(str(EAP_MULTICAST_MAC), (question,))


def _is_response(header: AmsHeader) -> bool:
    return bool(header.state_flags & StateFlags.RESPONSE)
