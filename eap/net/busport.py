"""Sockets of type 1: the master's end of a bus, and the end of a simulated segment.

On Ethernet the master recognizes its frames by the source address that they left with, and ignores
all others.  The first slave controller sets bit 1 of that address (ETG.1000.4); the master does not
require it, since emulated controllers leave the address as it was.  The simulated segment sets it.
By UDP a bus replies to the sender of a frame.  A simulated segment in another process is at the
other end of a socket pair.
"""

from __future__ import annotations

import errno
import os
import socket
import struct
import time
from collections.abc import Callable
from contextlib import suppress
from typing import NamedTuple

from eap.codec.ethercat import EAP_PORT, ETHERTYPE
from eap.errors import EnvironmentalError
from eap.ids import InterfaceUri, MacAddr
from eap.net.ipsocket import bind_failure
from eap.net.mmsg import SO_TIMESTAMPNS
from eap.net.packetsocket import join_type1, open_type1

BUS_MULTICAST_MAC = MacAddr.parse("01:01:05:01:00:00")
"""Destination of the frames of type 1 of masters; slaves process frames to any destination."""

_HEADER = 14
_PROCESSED = 0x02
_LARGEST = 2048
# Not every driver pads a short frame of a packet socket (IEEE 802.3: 60 bytes without FCS).
_MINIMUM = 60
_STAMP = struct.Struct("qq")
_CONTROL_SIZE = socket.CMSG_SPACE(_STAMP.size)
_BILLION = 1_000_000_000
_LOST = (BlockingIOError, ConnectionRefusedError)


class BusPort:
    """The master's end of one bus; ``fileno`` makes it fit for poll and select.

    Args:
        sock: As :func:`open_bus_socket` returns it, or one of a pair whose other end is a
            :class:`SegmentSocket`.
        interface: Name of the Ethernet interface; by default the one that *sock* is bound to.
        source: Source address of the frames; by default that of the interface.  Both lines of a
            ring have one, for the frames of each arrive on the other.

    Attributes:
        tap: Observer of each frame, from its EtherCAT header on, and whether it was sent.
    """

    def __init__(self, sock: socket.socket, *, interface: str = "", source: bytes = b"") -> None:
        self.tap: Callable[[bytes, bool], None] | None = None
        self._sock = sock
        self._interface = ""
        self._header = b""
        if sock.family == socket.AF_PACKET:
            bound = sock.getsockname()
            self._interface = interface or bound[0]
            # The interface may have been deleted while this process did not run.
            self._header = _ethernet_header(source or bound[4] or _made_up_address())
        self._own_source = _source(self._header) if self._header else b""
        sock.setblocking(False)
        sock.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)

    @property
    def source(self) -> bytes:
        """Source address of the frames on Ethernet, else nothing."""
        return self._header[6:12]

    def fileno(self) -> int:
        """Return the descriptor."""
        return self._sock.fileno()

    def close(self) -> None:
        """Close the socket."""
        self._sock.close()

    def send(self, frame: bytes) -> None:
        """Send a frame; one that the network does not take is lost, as frames are.

        Raises:
            EnvironmentalError: the interface is gone or switched off.
        """
        octets = (self._header + frame).ljust(_MINIMUM, b"\0") if self._header else frame
        if self.tap is not None:
            self.tap(frame, True)
        try:
            self._sock.send(octets)
        except _LOST:
            return
        except OSError as error:
            # A packet socket stays bound to the index of its interface; one that was made again
            # under the same name has another index.
            if self._interface and error.errno == errno.ENXIO:
                self._join_again()
            raise EnvironmentalError(f"the bus cannot be reached: {error.strerror}") from None

    def receive(self) -> bytes | None:
        """Return the next frame from its EtherCAT header on, None if there is none now.

        Raises:
            EnvironmentalError: the interface is gone or switched off.
        """
        while True:
            try:
                data = self._sock.recv(_LARGEST)
            except _LOST:
                return None
            except OSError as error:
                raise EnvironmentalError(f"the bus cannot be reached: {error.strerror}") from None
            if (frame := self._frame_in(data)) is not None:
                return frame or None

    def receive_stamped(self) -> tuple[bytes, int] | None:
        """Return the next frame and when it arrived, maybe long ago; raises as receive().

        The time is that of the monotonic clock, as the kernel noted it.
        """
        while True:
            try:
                data, ancillary, _, _ = self._sock.recvmsg(_LARGEST, _CONTROL_SIZE)
            except _LOST:
                return None
            except OSError as error:
                raise EnvironmentalError(f"the bus cannot be reached: {error.strerror}") from None
            if (frame := self._frame_in(data)) is not None:
                break
        now_ns = time.monotonic_ns()
        at_ns = now_ns
        for _, kind, stamp in ancillary:
            if kind == SO_TIMESTAMPNS:
                # It is by the clock of the host, which may have been set since.
                seconds, rest = _STAMP.unpack(stamp)
                at_ns = min(seconds * _BILLION + rest + now_ns - time.time_ns(), now_ns)
        return (frame, at_ns) if frame else None

    def _frame_in(self, data: bytes) -> bytes | None:
        """Return the frame that was received from its EtherCAT header on, None if not for us."""
        if self._header:
            # Without bit 1, which the first slave sets (ETG.1000.4) and some emulators do not.
            if len(data) <= _HEADER or _source(data) != self._own_source:
                return None
            data = data[_HEADER:]
        if data and self.tap is not None:
            self.tap(data, False)
        return data

    def _join_again(self) -> None:
        """Find the interface that was taken away, if another of its name has come."""
        with suppress(OSError, EnvironmentalError):
            join_type1(self._sock, self._interface, bytes(BUS_MULTICAST_MAC))
            # The address stays, although the new interface may have another one: the frames of
            # both lines of a ring have the same, and other masters have other addresses.


def open_bus_port(interface: InterfaceUri) -> BusPort:
    """Open a bus; raises as :func:`open_bus_socket` does."""
    return BusPort(open_bus_socket(interface))


def open_bus_socket(interface: InterfaceUri) -> socket.socket:
    """Open ``ethernet://IFACE``, or ``udp://ADDRESS[:PORT]`` of a host that forwards to a bus.

    Raises:
        EnvironmentalError: it cannot be opened, and why; or it is neither of the two.
    """
    if interface.scheme == "udp":
        return _open_udp(interface.host, interface.port or EAP_PORT)
    if interface.scheme == "ethernet":
        return open_type1(interface.host, group=bytes(BUS_MULTICAST_MAC))
    raise EnvironmentalError(
        f"{interface}: a bus is reached by ethernet://INTERFACE or udp://ADDRESS"
    )


def _open_udp(address: str, port: int) -> socket.socket:
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        # Connected, so that the kernel drops datagrams of all other hosts.
        sock.connect((address, port))
    except OSError as error:
        sock.close()
        raise EnvironmentalError(f"udp://{address}:{port}: {error.strerror}") from None
    return sock


def _source(data: bytes) -> bytes:
    return bytes((data[6] | _PROCESSED,)) + data[7:12]


def _made_up_address() -> bytes:
    first, *others = os.urandom(6)
    return bytes((first & ~0x01, *others))  # no multicast


def _ethernet_header(address: bytes) -> bytes:
    own = bytearray(address)
    own[0] &= ~_PROCESSED  # the bit by which the first slave marks what it has processed
    return bytes(BUS_MULTICAST_MAC) + own + struct.pack("!H", ETHERTYPE)


class Arrival(NamedTuple):
    """A frame from its EtherCAT header on, and what :meth:`SegmentSocket.send` needs to answer."""

    frame: bytearray
    origin: bytes | tuple[str, int]
    """An Ethernet header, an address, or nothing where there is but one other end."""


class SegmentSocket:
    """One open end; ``fileno`` makes it fit for poll and select.

    Args:
        sock: Of an Ethernet interface, of UDP, or of a pair whose other end is a BusPort.
    """

    def __init__(self, sock: socket.socket) -> None:
        self._sock = sock
        self._is_ethernet = sock.family == socket.AF_PACKET
        sock.setblocking(False)

    def fileno(self) -> int:
        """Return the descriptor."""
        return self._sock.fileno()

    def close(self) -> None:
        """Close the socket."""
        self._sock.close()

    def receive(self) -> Arrival | None:
        """Return the next frame, None if there is none now."""
        try:
            data, address = self._sock.recvfrom(_LARGEST)
        except OSError:  # nothing waits, or the interface is down: no reason to end
            return None
        if not self._is_ethernet:
            return Arrival(bytearray(data), address or b"") if data else None
        if len(data) < _HEADER:
            return None
        return Arrival(bytearray(data[_HEADER:]), data[:_HEADER])

    def send(self, frame: bytearray, origin: bytes | tuple[str, int]) -> None:
        """Send a frame back; one that the network does not take is lost, as frames are."""
        try:
            if isinstance(origin, tuple):
                self._sock.sendto(frame, origin)
                return
            if not origin:
                self._sock.send(frame)
                return
            header = bytearray(origin)
            header[6] |= _PROCESSED
            self._sock.send((header + frame).ljust(_MINIMUM, b"\0"))
        except OSError:
            return


def open_segment(interface: InterfaceUri) -> SegmentSocket:
    """Open ``ethernet://IFACE`` or ``udp://ADDRESS[:PORT]``.

    Raises:
        EnvironmentalError: it cannot be opened, and why; or it is neither of the two.
    """
    if interface.scheme == "udp":
        return SegmentSocket(_bind_udp(interface.host, interface.port or EAP_PORT))
    if interface.scheme == "ethernet":
        return SegmentSocket(open_type1(interface.host))
    raise EnvironmentalError(
        f"{interface}: a segment answers on ethernet://INTERFACE or udp://ADDRESS"
    )


def _bind_udp(address: str, port: int) -> socket.socket:
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        sock.bind((address, port))
    except OSError as error:
        sock.close()
        raise EnvironmentalError(bind_failure("UDP", address, port, error)) from None
    return sock
