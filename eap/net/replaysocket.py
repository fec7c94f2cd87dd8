"""Sockets that send recorded frames as their publishers did."""

from __future__ import annotations

import errno
import socket
from collections.abc import Callable
from ipaddress import IPv4Address
from time import monotonic

from eap.closeable import Closeable
from eap.codec.ethercat import EAP_PORT, ETHERTYPE
from eap.errors import EnvironmentalError
from eap.net.capture import FrameCapture
from eap.net.packetsocket import missing_capability


class ReplayUdpSocket(Closeable):
    """Sender of frames from one address of this host.

    Args:
        address: Address of the publisher's port.
        is_exclusive: Take UDP port 34980 too, as the publisher did: it cannot be alive then.

    Raises:
        EnvironmentalError: the address is none of this host.
        BlockingIOError: the port is in use: the publisher is alive.
    """

    def __init__(self, address: str, *, is_exclusive: bool) -> None:
        self._sock = sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            sock.bind((address, EAP_PORT if is_exclusive else 0))
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
            sock.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton(address))
        except OSError as exc:
            sock.close()
            if exc.errno == errno.EADDRINUSE:
                raise BlockingIOError(f"{address}:{EAP_PORT} is in use") from None
            raise EnvironmentalError(
                f"udp://{address}: {exc.strerror}; replay on the host that has this address, or as"
                " another station with --as"
            ) from None
        # Nobody reads what peers send to the publisher.
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1)
        sock.setblocking(False)

    def send(self, frame: bytes, destination: str) -> None:
        """Send one frame to ``address:port``; raise OSError if the kernel refuses it."""
        host, _, port = destination.partition(":")
        for attempt in range(2):
            try:
                self._sock.sendto(frame, (host, int(port or EAP_PORT)))
            except ConnectionRefusedError:
                # The ICMP error of an earlier frame: this one was not sent yet.
                if attempt:
                    raise
            else:
                return

    def close(self) -> None:
        """Close the socket."""
        self._sock.close()


class ReplayRawSocket(Closeable):
    """Sender of whole Ethernet frames at one interface.

    Raises:
        EnvironmentalError: the interface is missing, or CAP_NET_RAW.
    """

    def __init__(self, interface: str) -> None:
        try:
            self._sock = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, 0)
        except PermissionError:
            raise EnvironmentalError(missing_capability(interface)) from None
        try:
            self._sock.bind((interface, ETHERTYPE))
        except OSError as exc:
            self._sock.close()
            raise EnvironmentalError(f"ethernet://{interface}: {exc.strerror}") from None
        self._sock.setblocking(False)

    def send(self, packet: bytes, destination: str) -> None:
        """Send one packet from its Ethernet header on; raise OSError if the kernel refuses it."""
        del destination  # it is in the packet
        self._sock.send(packet)

    def close(self) -> None:
        """Close the socket."""
        self._sock.close()


def hear(interface: str, is_wanted: Callable[[bytes], bool], seconds: float) -> bool:
    """Return whether a wanted packet passes *interface* within *seconds*.

    Raises:
        EnvironmentalError: the interface is missing, or CAP_NET_RAW.
    """
    import select

    found = False

    def look(octets: memoryview, at_ns: int, tci: int) -> None:
        nonlocal found
        del at_ns, tci
        found = found or is_wanted(bytes(octets))

    capture = FrameCapture(interface)
    try:
        end_s = monotonic() + seconds
        while not found and (left_s := end_s - monotonic()) > 0:
            if select.select([capture], [], [], left_s)[0]:
                capture.drain(look)
    finally:
        capture.close()
    return found


def is_ipv4(text: str) -> bool:
    """Return whether *text* is an IPv4 address."""
    try:
        IPv4Address(text)
    except ValueError:
        return False
    return True
