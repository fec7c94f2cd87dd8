"""Opening AF_PACKET sockets, always a pair: one for the engine, one for services."""

from __future__ import annotations

import os
import shlex
import socket
import sys

from eap.errors import EnvironmentalError
from eap.net import bpf
from eap.net.interface import check_interface
from eap.net.udpsocket import prepare_receiver

SOL_PACKET = 263
PACKET_ADD_MEMBERSHIP = 1
PACKET_AUXDATA = 8
PACKET_IGNORE_OUTGOING = 23
PACKET_MR_MULTICAST = 0
_ETH_P_ALL = 3
_ARPHRD_ETHER = 1
_ARPHRD_LOOPBACK = 772


def open_packet_pair(interface: str) -> tuple[socket.socket, socket.socket]:
    """Open *interface* for EtherType 0x88A4 and let the kernel sort what arrives by frame type.

    All protocols are asked for and filtered, because only then does the kernel say from which VLAN
    a frame came.

    Returns:
        The engine's socket and that of services.

    Raises:
        EnvironmentalError: the interface is missing, down or no Ethernet, or CAP_NET_RAW is.
    """
    check_interface(interface)
    engine = _open(interface, bpf.Role.ENGINE)
    try:
        return engine, _open(interface, bpf.Role.SERVICES)
    except BaseException:
        engine.close()
        raise


def _open(interface: str, role: bpf.Role) -> socket.socket:
    try:
        # Of protocol 0, hence deaf: no foreign frame gets in before the filter is in place.
        sock = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, 0)
    except PermissionError:
        raise EnvironmentalError(missing_capability(interface)) from None
    try:
        _set_up(sock, interface, role)
    except BaseException:
        sock.close()
        raise
    return sock


def _set_up(sock: socket.socket, interface: str, role: bpf.Role) -> None:
    try:
        bpf.attach(sock, bpf.packet_filter(role))
        sock.setsockopt(SOL_PACKET, PACKET_AUXDATA, 1)
        sock.setsockopt(SOL_PACKET, PACKET_IGNORE_OUTGOING, 1)
        prepare_receiver(sock)
        sock.bind((interface, _ETH_P_ALL))
    except OSError as error:
        raise EnvironmentalError(f"interface {interface}: {error.strerror}") from None
    if sock.getsockname()[3] not in (_ARPHRD_ETHER, _ARPHRD_LOOPBACK):
        raise EnvironmentalError(f"interface {interface} is not an Ethernet interface")


def missing_capability(interface: str) -> str:
    """Say in one line what opening *interface* needs and how to get it for this run only."""
    start = f"ethernet://{interface} needs the capability CAP_NET_RAW"
    if os.geteuid() == 0:
        cure = "root lacks it here: give it to the container (such as --cap-add=NET_RAW)"
    else:
        command = shlex.join([sys.executable, *sys.orig_argv[1:]])
        cure = (
            f"grant it to this one run, as root: `setpriv --reuid={os.getuid()} "
            f"--regid={os.getgid()} --init-groups --inh-caps=+net_raw --ambient-caps=+net_raw "
            f"{command}`"
        )
    return f"{start}; {cure}; or use udp://ADDRESS, which needs no privilege"
