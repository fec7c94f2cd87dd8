"""One Ethernet segment: stations that are reached by MAC address, or by the NetID of their port.

Who has a NetID is asked as ARP does it, in the terms of AoE: a ReadState goes to the multicast
address of EAP, only who is meant answers, and the answer shows the address (own format; any device
that answers AoE frames to this address can be found).  It is asked again now and then, for devices
are exchanged.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from time import monotonic_ns
from typing import NamedTuple

from eap.ams.hop_prober import PROBE_PORT
from eap.codec.ams import DEVICE_PORT, AmsCommand, AmsHeader, StateFlags
from eap.errors import CodecError
from eap.ids import EAP_MULTICAST_MAC, MacAddr, NetId
from eap.pd.link import FrameChannel
from eap.services.transports.demultiplexer import Demultiplexer
from eap.services.transports.mailbox_frames import ChannelSender

ASK_NS = 1_000_000_000
"""Between two questions for a NetID that nobody answered."""
ASK_AGAIN_NS = 30_000_000_000
"""Between two questions for one whose address is known."""


class _Place(NamedTuple):
    mac: str
    """Empty while it is not known."""
    asked_at_ns: int | None


class Segment:
    """The way in from one interface and VLAN, and the addresses of its stations.

    Args:
        entrance: To the stations of this host that are on it.
        mac: Own address.
    """

    def __init__(self, demultiplexer: Demultiplexer, mac: MacAddr) -> None:
        self.mac = str(mac)
        self._demultiplexer = demultiplexer
        self._places: dict[NetId, _Place] = {}

    def receive(self, data: bytes, connection: str, *, for_all: bool = False) -> None:
        """Act on a packet; the arguments are those of :meth:`Demultiplexer.receive`."""
        self._learn(data, connection)
        self._demultiplexer.receive(data, connection, for_all=for_all)

    def find(self, net_id: NetId, now_ns: int, ask: Callable[[], object]) -> str:
        """Return the MAC address of a port, empty while it is not known; *ask* when it is time."""
        if self._demultiplexer.has(net_id):
            self._demultiplexer.hop_is_at(str(net_id), self.mac)
            return self.mac
        place = self._places.get(net_id, _Place("", None))
        pause_ns = ASK_AGAIN_NS if place.mac else ASK_NS
        if place.asked_at_ns is None or now_ns - place.asked_at_ns >= pause_ns:
            self._places[net_id] = place._replace(asked_at_ns=now_ns)
            ask()
        return place.mac

    def _learn(self, data: bytes, mac: str) -> None:
        if not self._places:
            return
        try:
            header = AmsHeader.decode(data)
        except CodecError:
            return
        place = self._places.get(header.source)
        if place is None or header.target_port != PROBE_PORT or not _is_response(header):
            return
        if place.mac != mac and self._demultiplexer.has(header.target):
            self._places[header.source] = place._replace(mac=mac)
            self._demultiplexer.hop_is_at(str(header.source), mac)


class SegmentSender:
    """Sends packets of one station to MAC addresses, and to NetIDs of ports.

    Args:
        segment: Where they are.
        channel: Of the station's port.
        net_id: Of the station's router, in whose name is asked.
    """

    def __init__(self, segment: Segment, channel: FrameChannel, net_id: NetId) -> None:
        self._segment = segment
        self._sender = ChannelSender(channel)
        self._net_id = net_id

    def send(self, connection: str, packets: tuple[bytes, ...]) -> str | None:
        """Send packets to an address; return why not if that cannot be done."""
        mac = connection
        if ":" not in connection:
            net_id = NetId.parse(connection)
            mac = self._segment.find(net_id, monotonic_ns(), lambda: self._ask(net_id))
        if not mac:
            return "nobody has said yet which MAC address it has"
        if mac != self._segment.mac:
            return self._sender.send(mac, packets)
        loop = asyncio.get_running_loop()
        for packet in packets:  # a packet socket does not get what its own host sends
            loop.call_soon(self._segment.receive, packet, mac)
        return None

    def _ask(self, net_id: NetId) -> None:
        question = AmsHeader(
            net_id, DEVICE_PORT, self._net_id, PROBE_PORT, AmsCommand.READ_STATE
        ).encode()
        self._sender.send(str(EAP_MULTICAST_MAC), (question,))


def _is_response(header: AmsHeader) -> bool:
    return bool(header.state_flags & StateFlags.RESPONSE)
