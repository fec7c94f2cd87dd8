"""Opening the sockets of AMS routers: AMS/TCP 48898, and UDP 48899 on which they are found.

A machine may have a router of its own, such as that of a PLC run-time; so who is refused is told
how to do without.
"""

from __future__ import annotations

import socket

from eap.codec.amsdiscovery import AMS_UDP_PORT
from eap.codec.amstcp import AMS_TCP_PORT
from eap.errors import EnvironmentalError
from eap.net.tcp import open_tcp_listener
from eap.net.udpsocket import bind_failure

_WITHOUT = "; without AMS at this address the station runs too: `ams: false` at its EAP ports there"


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
        sock.bind((address, AMS_UDP_PORT))
    except OSError as error:
        sock.close()
        reason = bind_failure("UDP", address, AMS_UDP_PORT, error)
        raise EnvironmentalError(f"{reason}{_WITHOUT}") from None
    return sock
