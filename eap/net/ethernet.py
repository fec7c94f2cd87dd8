"""The Ethernet driver: EtherType 0x88A4 through one AF_PACKET socket for all ports of a process."""

from __future__ import annotations

import socket
import struct
import sys
from collections import deque
from collections.abc import Callable, Sequence
from ctypes import get_errno
from errno import EAGAIN, ENETDOWN

from eap.codec.ethercat import ETHERTYPE
from eap.compiled import override
from eap.ids import BROADCAST_MAC, EAP_MULTICAST_MAC, Destination, MacAddr
from eap.net.mmsg import BATCH, BUFFER_SIZE, ReceiveBatch, SendBatch, note_receive_error
from eap.net.packetsocket import InterfaceBinding
from eap.pd.link import FrameHandler, OutFrame, exchange

ETHERNET_HEADER = 14
MINIMUM_SIZE = 60
"""Shortest frame without its check sequence (IEEE 802.3)."""

_SOURCE = struct.Struct("6x6s").unpack_from
"""The source address in an Ethernet header."""
_SOURCE_FIELD = slice(6, 12)
_TPID = 0x8100
_VID = 0x0FFF
_CONTROL_SIZE = 72  # a time stamp, then the auxiliary data of a packet
_TCI = 32  # of the 36 half words
_BATCHES_PER_DRAIN = 4
_LOCAL_LIMIT = 1024

# The first word of a frame is its destination and two octets more.
_MAC_MASK = int.from_bytes(b"\xff" * 6 + bytes(2), sys.byteorder)


def packet_batch() -> ReceiveBatch:
    """Return receive memory for the Ethernet interfaces of a process, which may share it."""
    return ReceiveBatch(_CONTROL_SIZE, ETHERNET_HEADER, with_senders=False)


class EthernetInterface:
    """One AF_PACKET socket and the ports of all stations that share it.

    An interface that is deleted and made again is found again by its name, mostly with another
    address; then frames that were built before get the new one when they are sent.

    Args:
        sock: Of :func:`eap.net.packetsocket.open_packet_pair`.
        batch: Receive memory.
        name: Name of the interface; by default that to which *sock* is bound.

    Attributes:
        address: The interface's own MAC address.
        errors: Failed system calls by errno name.
        has_neighbours: Whether several ports share the interface.
        discarded: Frames taken from the wire and dropped here, by reason.
        on_found: Called after the interface was found again.
    """

    def __init__(self, sock: socket.socket, batch: ReceiveBatch, name: str = "") -> None:
        sock.setblocking(False)
        self._binding = InterfaceBinding(sock, name)
        self.name = self._binding.name
        self.address = self._binding.address
        self.on_found: list[Callable[[], object]] = []
        self.sender = SendBatch(sock)
        self.errors = self.sender.errors
        self.discarded = {"other_vlan": 0, "local_overflow": 0}
        self._sock = sock
        self._batch = batch
        self._receive = batch.reader(sock.fileno())
        self._octets = batch.octets
        self._heads = batch.octets.cast("Q")
        self._tags = batch.control.cast("H")
        self._routes: dict[int, dict[int, list[FrameHandler]]] = {}
        self._own_source = bytes(self.address)
        self._ports: list[EthernetPort] = []
        self.has_neighbours = False
        self._local: deque[tuple[FrameHandler, memoryview, int]] = deque()
        self.compiled = batch.compiled_socket(sock.fileno(), self._routes, self, self.sender)
        self.allow_compiled()

    def port(
        self,
        handler: FrameHandler,
        *,
        vlan_id: int = 0,
        priority: int = 0,
        join: Sequence[str] = (),
    ) -> EthernetPort:
        """Return a new port that takes and sends frames of *vlan_id*; 0 is untagged.

        It receives frames to the interface's address, broadcasts, the EAP multicast address and
        the multicast MAC addresses of *join*.
        """
        port = self.make_port(handler, vlan_id=vlan_id, priority=priority, join=join)
        self.add(port)
        return port

    def make_port(
        self,
        handler: FrameHandler,
        *,
        vlan_id: int = 0,
        priority: int = 0,
        join: Sequence[str] = (),
    ) -> EthernetPort:
        """Return a port as :meth:`port` does, which receives nothing before it is added."""
        groups = {EAP_MULTICAST_MAC, *(MacAddr.parse(text) for text in join)}
        for group in groups:
            self._binding.join(group)
        return EthernetPort(self, handler, vlan_id, priority, frozenset(groups))

    def add(self, port: EthernetPort) -> None:
        """Receive frames for *port* from now on."""
        by_address = self._routes.setdefault(port.vlan_id, {})
        for address in (self.address, BROADCAST_MAC, *port.groups):
            by_address.setdefault(_key(address), []).append(port.handler)
        self._ports.append(port)
        # Copies for other ports cost time in each cycle, so a single port makes none.
        self.has_neighbours = len(self._ports) > 1
        self.allow_compiled()
        if port.own_address != self.address:
            port.readdress()

    def remove(self, port: EthernetPort) -> None:
        """Receive nothing for *port* any more."""
        # The socket stays a member of the port's groups: to leave one waits for a lock of the
        # kernel, and this is called between two cycles.
        self._ports.remove(port)
        self.has_neighbours = len(self._ports) > 1
        self.allow_compiled()
        by_address = self._routes[port.vlan_id]
        for address in (self.address, BROADCAST_MAC, *port.groups):
            by_address[_key(address)].remove(port.handler)
            if not by_address[_key(address)]:
                del by_address[_key(address)]
        if not by_address:
            del self._routes[port.vlan_id]
        self._local = deque(each for each in self._local if each[0] != port.handler)

    def allow_compiled(self) -> None:
        """Have Python do what the compiled part knows nothing of."""
        if self.compiled is not None:
            self.compiled.may_drain = not (self._local or self._binding.is_lost)
            is_readdressed = any(port.is_readdressed for port in self._ports)
            self.compiled.may_send = not (self.has_neighbours or is_readdressed)

    def drain(self) -> int:
        """Hand every waiting frame to the ports it is for; return how many were handed over."""
        total = self._drain_local() if self._local else 0
        for _ in range(_BATCHES_PER_DRAIN):
            count = self._receive()
            if count == 1:
                return total + self._dispatch_one()
            if count < 0:
                if self._binding.is_lost or get_errno() != EAGAIN:
                    self.note_error(get_errno())
                break
            total += self._dispatch(count)
            if count < BATCH:
                break
        return total

    def find(self) -> None:
        """Look for an interface that was deleted: has it been made again?"""
        is_found = self._binding.find()
        self.allow_compiled()
        if not is_found:
            return
        before, self.address = self.address, self._binding.address
        if self.address != before:
            self._own_source = bytes(self.address)
            for by_address in self._routes.values():
                by_address[_key(self.address)] = by_address.pop(_key(before))
            for port in self._ports:
                port.readdress()
        for notify in self.on_found:
            notify()

    def deliver(self, frames: Sequence[OutFrame], sender: EthernetPort, now_ns: int) -> None:
        """Keep copies of *frames* for the other ports they are for, until they are drained.

        A packet socket never receives what its own host sends.
        """
        by_address = self._routes[sender.vlan_id]
        for frame in frames:
            handlers = by_address.get(_key(frame.buffer), ())
            others = [handler for handler in handlers if handler is not sender.handler]
            if not others:
                continue
            # A copy: the publisher patches the buffer again before the other port is drained.
            data = memoryview(bytes(frame.view[frame.headroom :]))
            for handler in others:
                if len(self._local) >= _LOCAL_LIMIT:
                    self.discarded["local_overflow"] += 1
                else:
                    self._local.append((handler, data, now_ns))
        self.allow_compiled()

    def exchange_handler(self, old: FrameHandler, new: FrameHandler) -> None:
        """Hand to *new* the frames that were handed to *old*, if it is a handler here."""
        for by_address in self._routes.values():
            for handlers in by_address.values():
                exchange(handlers, old, new)
        for port in self._ports:
            if port.handler is old:
                port.handler = new

    def sender_of(self, data: memoryview) -> str:
        """Return the source address of the frame in *data*; nothing if it is none of a station."""
        source = MacAddr(self.source_of(data))
        return "" if source.is_group else str(source)

    def source_of(self, data: memoryview) -> bytes:
        """Return the source address of the frame in *data*; the interface's own by deliver()."""
        position = self._batch.position(data)
        if position is None:
            return self._own_source
        source: bytes = _SOURCE(self._octets, position * BUFFER_SIZE)[0]
        return source

    def is_group_frame(self, data: memoryview) -> bool:
        """Return whether the frame in *data* is a multicast or a broadcast."""
        position = self._batch.position(data)
        return position is not None and bool(self._batch.octets[position * BUFFER_SIZE] & 1)

    def fileno(self) -> int:
        """Return the descriptor that becomes readable when a frame waits."""
        return self._sock.fileno()

    def close(self) -> None:
        """Close the socket."""
        self._sock.close()

    def note_error(self, number: int) -> bool:
        """Note why nothing was received; return False, for nothing waits behind it."""
        if number == ENETDOWN:
            # Once, for switched off as for deleted.
            self._binding.is_lost = True
            self.allow_compiled()
        note_receive_error(self.errors, number)
        self.find()
        return False

    def count_unrouted(self, position: int) -> None:
        """Count the frame at *position* in the batch, if it is of an unknown VLAN."""
        head = self._heads[position * (BUFFER_SIZE // 8)]
        self._handlers(head, self._tags[position * (_CONTROL_SIZE // 2) + _TCI])

    def _dispatch_one(self) -> int:
        handlers = self._handlers(self._heads[0], self._tags[_TCI])
        if not handlers:
            return 0
        view, size, at_ns = self._batch.arrival()
        for handle in handlers:
            handle(view, size - ETHERNET_HEADER, at_ns, self)
        return 1

    def _dispatch(self, count: int) -> int:
        taken = 0
        heads = self._heads[: count * BUFFER_SIZE // 8 : BUFFER_SIZE // 8].tolist()
        tags = self._tags[_TCI : count * _CONTROL_SIZE // 2 : _CONTROL_SIZE // 2].tolist()
        sizes, times = self._batch.arrivals(count)
        if heads.count(heads[0]) == tags.count(tags[0]) == count:
            only = self._routes.get(tags[0] & _VID, {}).get(heads[0] & _MAC_MASK, [])
            if len(only) == 1:  # a burst of one sender for one port: nothing to tell apart
                handle = only[0]
                for view, size, at_ns in zip(self._batch.views, sizes, times, strict=False):
                    handle(view, size - ETHERNET_HEADER, at_ns, self)
                return count
        find = self._handlers
        for view, size, at_ns, head, tag in zip(
            self._batch.views, sizes, times, heads, tags, strict=False
        ):
            if handlers := find(head, tag):
                taken += 1
                for handle in handlers:
                    handle(view, size - ETHERNET_HEADER, at_ns, self)
        return taken

    def _handlers(self, head: int, tag: int) -> Sequence[FrameHandler]:
        """Return the handlers of a frame with this first word and VLAN tag; count unknown VLANs."""
        by_address = self._routes.get(tag & _VID)
        if by_address is None:
            self.discarded["other_vlan"] += 1
            return ()
        return by_address.get(head & _MAC_MASK, ())

    def _drain_local(self) -> int:
        count = len(self._local)
        for _ in range(count):
            handle, data, at_ns = self._local.popleft()
            handle(data, len(data), at_ns, self)
        self.allow_compiled()
        return count


class EthernetPort:
    """One station's port on a shared interface: a channel of its own VLAN."""

    minimum_size = MINIMUM_SIZE

    def __init__(
        self,
        interface: EthernetInterface,
        handler: FrameHandler,
        vlan_id: int,
        priority: int,
        groups: frozenset[MacAddr],
    ) -> None:
        self.interface = interface
        self.handler = handler
        self.vlan_id = vlan_id
        self.groups = groups
        self.own_address = interface.address
        self._send = interface.sender.send
        self.is_readdressed = False
        self.direct = interface.compiled
        override(self, "drain", interface.compiled)
        # VID 0 with a priority is a priority tag (802.1Q); without both the frame is untagged.
        tag = priority << 13 | vlan_id
        self._tag = struct.pack("!HH", _TPID, tag) if tag else b""

    def drain(self, now_ns: int) -> int:
        """Hand over what waits at the interface, to this and to its other ports."""
        del now_ns
        return self.interface.drain()

    def send(self, frames: Sequence[OutFrame], now_ns: int) -> Sequence[OutFrame]:
        """Send *frames* to the wire and to this host's other ports; return those not sent."""
        failed = self._send(frames)
        if self.interface.has_neighbours:
            sent = [frame for frame in frames if frame not in failed] if failed else frames
            self.interface.deliver(sent, self, now_ns)
        return failed

    def exchange_handler(self, old: FrameHandler, new: FrameHandler) -> None:
        """Exchange a handler of the interface."""
        self.interface.exchange_handler(old, new)

    def readdress(self) -> None:
        """Write the interface's present address into each frame that is sent from now on."""
        # Frames are prebuilt, by publishers and repliers; only sending sees all of them.
        self._send = self._send_readdressed
        self.is_readdressed = True
        self.interface.allow_compiled()

    def link_header(self, destination: str) -> bytes:
        """Return destination, own address, the port's VLAN tag if it has one, and EtherType."""
        target = MacAddr.parse(Destination.parse(destination).host)
        return target + self.interface.address + self._tag + struct.pack("!H", ETHERTYPE)

    def fileno(self) -> int:
        """Return the descriptor that becomes readable when a frame waits."""
        return self.interface.fileno()

    def _send_readdressed(self, frames: Sequence[OutFrame]) -> Sequence[OutFrame]:
        address = self.interface.address
        for frame in frames:
            frame.buffer[_SOURCE_FIELD] = address
        return self.interface.sender.send(frames)


def _key(address: bytes | bytearray) -> int:
    """Return the first word of frames to *address*, masked as they are when they arrive."""
    return int.from_bytes(address[:6] + bytes(2), sys.byteorder)
