"""Opening the sockets of AMS routers: AMS/TCP 48898, and UDP 48899 on which they are found.

A machine may have a router of its own, such as that of a PLC run-time; so who is refused is told
how to do without.
"""

from __future__ import annotations

import logging
import socket

from eap.codec.amsdiscovery import AMS_UDP_PORT
from eap.codec.amstcp import AMS_TCP_PORT
from eap.errors import EnvironmentalError
from eap.net.interface import broadcast_of, interface_of
from eap.net.tcp import open_tcp_listener
from eap.net.udpsocket import bind_failure

_WITHOUT = "; without AMS at this address the station runs too: `ams: false` at its EAP ports there"

logger = logging.getLogger(__name__)


def open_ams_listener(address: str) -> socket.socket:
    """Return a socket that listens on *address* for AMS/TCP.

    Raises:
        EnvironmentalError: the port is taken, and by whom, or the address is not this machine's.
    """
    try:
        return open_tcp_listener(address, AMS_TCP_PORT)
    except EnvironmentalError as exc:
        raise EnvironmentalError(f"{exc}{_WITHOUT}") from None


def open_ams_socket(address: str) -> socket.socket:
    """Return a socket bound to *address* for datagrams of tools; raises as the other one."""
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)  # for questions to all
        sock.bind((address, AMS_UDP_PORT))
    except OSError as error:
        sock.close()
        reason = bind_failure("UDP", address, AMS_UDP_PORT, error)
        raise EnvironmentalError(f"{reason}{_WITHOUT}") from None
    return sock


def open_ams_broadcast(address: str, group: str) -> socket.socket | None:
    """Return a socket for questions of tools to all hosts of the network that *address* is in.

    What does not work is a warning and None: the station is found at its address all the same.

    Args:
        address: Of this machine.
        group: The broadcast address; empty for that of the network.
    """
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # each station has its own
        interface = interface_of(address).encode()
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, interface)
        if group := group or broadcast_of(address):
            sock.bind((group, AMS_UDP_PORT))
            return sock
        reason = "the network has no broadcast address"
    except OSError as exc:
        reason = exc.strerror or str(exc)
    logger.warning("tools do not find %s by broadcast (UDP %d): %s", address, AMS_UDP_PORT, reason)
    sock.close()
    return None
