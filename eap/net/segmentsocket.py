"""The socket at the end of a simulated segment: frames of a master in, the same frames back.

On Ethernet a frame goes back with bit 1 of its source address set, as the first slave controller
does it; by UDP it goes back to where it came from, and over a pair to its only other end.
"""

from __future__ import annotations

import socket
from typing import NamedTuple

from eap.codec.ethercat import EAP_PORT
from eap.errors import EnvironmentalError
from eap.ids import InterfaceUri
from eap.net.packetsocket import open_type1
from eap.net.udpsocket import bind_failure

_HEADER = 14
_PROCESSED = 0x02
_LARGEST = 2048
_MINIMUM = 60


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
        return SegmentSocket(_open_udp(interface.host, interface.port or EAP_PORT))
    if interface.scheme == "ethernet":
        return SegmentSocket(open_type1(interface.host))
    raise EnvironmentalError(
        f"{interface}: a segment answers on ethernet://INTERFACE or udp://ADDRESS"
    )


def _open_udp(address: str, port: int) -> socket.socket:
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        sock.bind((address, port))
    except OSError as error:
        sock.close()
        raise EnvironmentalError(bind_failure("UDP", address, port, error)) from None
    return sock
