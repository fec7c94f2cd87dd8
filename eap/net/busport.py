"""The socket of a master: frames of type 1 go out to a bus and come back through it.

On Ethernet frames come back with the source address they left with, and are known by it: what
others say on the same network is not taken.  The first slave controller sets a bit in that address
(ETG.1000.4); it is not asked for, since emulated controllers leave it as it was.  By UDP a bus
answers whoever asked it; a simulated segment in another process is at the other end of a pair.
"""

from __future__ import annotations

import errno
import socket
import struct
from contextlib import suppress

from eap.codec.ethercat import EAP_PORT, ETHERTYPE
from eap.errors import EnvironmentalError
from eap.ids import InterfaceUri, MacAddr
from eap.net.packetsocket import join_type1, open_type1

BUS_MULTICAST_MAC = MacAddr.parse("01:01:05:01:00:00")
"""Where masters send frames of type 1; slaves take them whatever their destination is."""

_HEADER = 14
_PROCESSED = 0x02
_LARGEST = 2048
_MINIMUM = 60
_LOST = (BlockingIOError, ConnectionRefusedError)


class BusPort:
    """The master's end of one bus; ``fileno`` makes it fit for poll and select.

    Args:
        sock: As :func:`open_bus_socket` returns it, or one of a pair whose other end is a
            :class:`SegmentSocket`.
    """

    def __init__(self, sock: socket.socket) -> None:
        self._sock = sock
        self._interface = sock.getsockname()[0] if sock.family == socket.AF_PACKET else ""
        self._header = _ethernet_header(sock) if sock.family == socket.AF_PACKET else b""
        sock.setblocking(False)

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
        try:
            self._sock.send(octets)
        except _LOST:
            return
        except OSError as error:
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
            if not self._header:
                return data or None
            if len(data) > _HEADER and _source(data) == _source(self._header):
                return data[_HEADER:]

    def _join_again(self) -> None:
        """Find the interface that was taken away, if another of its name has come."""
        with suppress(OSError, EnvironmentalError):
            join_type1(self._sock, self._interface, bytes(BUS_MULTICAST_MAC))
            self._header = _ethernet_header(self._sock)


def open_bus_port(interface: InterfaceUri) -> BusPort:
    """Open a bus; raises as :func:`open_bus_socket` does."""
    return BusPort(open_bus_socket(interface))


def open_bus_socket(interface: InterfaceUri) -> socket.socket:
    """Open ``ethernet://IFACE``, or ``udp://ADDRESS[:PORT]`` of whoever passes frames to a bus.

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
        sock.connect((address, port))
    except OSError as error:
        sock.close()
        raise EnvironmentalError(f"udp://{address}:{port}: {error.strerror}") from None
    return sock


def _source(data: bytes) -> bytes:
    return bytes((data[6] | _PROCESSED,)) + data[7:12]


def _ethernet_header(sock: socket.socket) -> bytes:
    own = bytearray(sock.getsockname()[4])
    own[0] &= ~_PROCESSED  # the bit by which the first slave marks what it has processed
    return bytes(BUS_MULTICAST_MAC) + own + struct.pack("!H", ETHERTYPE)
