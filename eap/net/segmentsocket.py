"""The socket at the end of a simulated segment: frames of a master in, the same frames back.

On Ethernet a frame goes back with bit 1 of its source address set, as the first slave controller
does it; by UDP it goes back to where it came from.
"""

from __future__ import annotations

import socket
import struct
from typing import NamedTuple

from eap.codec.ethercat import EAP_PORT, ETHERTYPE
from eap.errors import EnvironmentalError
from eap.ids import InterfaceUri
from eap.net.interface import check_interface
from eap.net.packetsocket import (
    PACKET_ADD_MEMBERSHIP,
    PACKET_IGNORE_OUTGOING,
    SOL_PACKET,
    missing_capability,
)
from eap.net.udpsocket import bind_failure

_PROMISCUOUS = 1
_HEADER = 14
_PROCESSED = 0x02
_LARGEST = 2048
_MINIMUM = 60


class Arrival(NamedTuple):
    """A frame from its EtherCAT header on, and what :meth:`SegmentSocket.send` needs to answer."""

    frame: bytearray
    origin: bytes | tuple[str, int]


class SegmentSocket:
    """One open end; ``fileno`` makes it fit for poll and select."""

    def __init__(self, sock: socket.socket, *, is_ethernet: bool) -> None:
        self._sock = sock
        self._is_ethernet = is_ethernet
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
        except (BlockingIOError, ConnectionRefusedError):
            return None
        if not self._is_ethernet:
            return Arrival(bytearray(data), address)
        if len(data) < _HEADER:
            return None
        return Arrival(bytearray(data[_HEADER:]), data[:_HEADER])

    def send(self, frame: bytearray, origin: bytes | tuple[str, int]) -> None:
        """Send a frame back; one that the network does not take is lost, as frames are."""
        try:
            if isinstance(origin, tuple):
                self._sock.sendto(frame, origin)
                return
            header = bytearray(origin)
            header[6] |= _PROCESSED
            self._sock.send((header + frame).ljust(_MINIMUM, b"\0"))
        except (BlockingIOError, ConnectionRefusedError, OSError):
            return


def open_segment(interface: InterfaceUri) -> SegmentSocket:
    """Open ``ethernet://IFACE`` or ``udp://ADDRESS[:PORT]``.

    Raises:
        EnvironmentalError: it cannot be opened, and why; or it is neither of the two.
    """
    if interface.scheme == "udp":
        return _open_udp(interface.host, interface.port or EAP_PORT)
    if interface.scheme == "ethernet":
        return _open_ethernet(interface.host)
    raise EnvironmentalError(
        f"{interface}: a segment answers on ethernet://INTERFACE or udp://ADDRESS"
    )


def _open_udp(address: str, port: int) -> SegmentSocket:
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        sock.bind((address, port))
    except OSError as error:
        sock.close()
        raise EnvironmentalError(bind_failure("UDP", address, port, error)) from None
    return SegmentSocket(sock, is_ethernet=False)


def _open_ethernet(name: str) -> SegmentSocket:
    check_interface(name)
    try:
        sock = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, 0)
    except PermissionError:
        raise EnvironmentalError(missing_capability(name)) from None
    try:
        sock.setsockopt(SOL_PACKET, PACKET_IGNORE_OUTGOING, 1)
        sock.bind((name, ETHERTYPE))
        membership = struct.pack("iHH8s", socket.if_nametoindex(name), _PROMISCUOUS, 0, b"")
        sock.setsockopt(SOL_PACKET, PACKET_ADD_MEMBERSHIP, membership)
    except OSError as error:
        sock.close()
        raise EnvironmentalError(f"interface {name}: {error.strerror}") from None
    return SegmentSocket(sock, is_ethernet=True)
