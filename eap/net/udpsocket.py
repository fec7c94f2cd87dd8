"""Opening UDP sockets, always a pair: one for the engine, one for services.

The supervisor calls these, keeps what it opened and hands the descriptors down.  The index of a
socket in its SO_REUSEPORT group follows the order of binding and changes when a member closes,
so nobody else may bind and nothing may be closed while the appliance runs.
"""

from __future__ import annotations

import errno
import socket

from eap.codec.ethercat import EAP_PORT
from eap.errors import EnvironmentalError
from eap.net import bpf
from eap.net.interface import foreign_address, interface_of
from eap.net.mmsg import SO_TIMESTAMPNS
from eap.net.portholder import describe_holder

SO_RCVBUFFORCE = 33
IP_MULTICAST_ALL = 49
_RECEIVE_BUFFER = 8 << 20


def open_udp_pair(address: str, port: int = EAP_PORT) -> tuple[socket.socket, socket.socket]:
    """Bind *address* twice and let the kernel sort what arrives by frame type.

    Returns:
        The engine's socket, which also sends, and that of services.

    Raises:
        EnvironmentalError: the port is taken, and by whom, or the address is not this machine's.
    """
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as trial:
        # Without this a second appliance would join the group and take half of the frames.
        _bind(trial, address, port)
    pair = _two_sockets()
    try:
        engine, services = pair
        for sock in pair:
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEPORT, 1)
            prepare_receiver(sock)
        engine.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
        _bind(engine, address, port)
        bpf.attach(engine, bpf.reuseport_index(), bpf.SO_ATTACH_REUSEPORT_CBPF)
        _bind(services, address, port)
        if address != "0.0.0.0":  # noqa: S104  a comparison
            out = socket.inet_aton(address)
            engine.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, out)
        engine.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, 1)
        engine.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_LOOP, 1)
    except BaseException:
        _close(pair)
        raise
    return pair


def open_udp_receiver(address: str, port: int) -> socket.socket:
    """Return a socket that is bound to *address*, for one process alone.

    Raises:
        EnvironmentalError: the port is taken, and by whom, or the address is not this machine's.
    """
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        prepare_receiver(sock)
        _bind(sock, address, port)
    except BaseException:
        sock.close()
        raise
    return sock


def open_udp_group_pair(
    group: str, interface_address: str, port: int = EAP_PORT
) -> tuple[socket.socket, socket.socket]:
    """Listen to a multicast *group* or a broadcast address, on one interface only.

    Every socket that is bound to a group gets a copy of each frame, so each of the two filters
    out what belongs to the other process.

    Returns:
        The engine's socket and that of services; both only receive.

    Raises:
        EnvironmentalError: the address cannot be bound, or no interface has *interface_address*.
    """
    pair = _two_sockets()
    try:
        for role, sock in zip(bpf.Role, pair, strict=True):
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            prepare_receiver(sock)
            bpf.attach(sock, bpf.udp_filter(role))
            if _is_multicast(group):
                sock.setsockopt(socket.IPPROTO_IP, IP_MULTICAST_ALL, 0)
            else:
                _bind_to_interface(sock, interface_address)
            _bind(sock, group, port)
            if _is_multicast(group):
                _join(sock, group, interface_address)
    except BaseException:
        _close(pair)
        raise
    return pair


def prepare_receiver(sock: socket.socket) -> None:
    """Ask for kernel time stamps and for as much receive buffer as this process may have."""
    sock.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
    try:
        sock.setsockopt(socket.SOL_SOCKET, SO_RCVBUFFORCE, _RECEIVE_BUFFER)
    except PermissionError:
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BUFFER)


def _two_sockets() -> tuple[socket.socket, socket.socket]:
    first = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        return first, socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    except BaseException:
        first.close()
        raise


def _close(pair: tuple[socket.socket, socket.socket]) -> None:
    for sock in pair:
        sock.close()


def _bind(sock: socket.socket, address: str, port: int) -> None:
    try:
        sock.bind((address, port))
    except OSError as error:
        raise EnvironmentalError(bind_failure("UDP", address, port, error)) from None


def bind_failure(protocol: str, address: str, port: int, error: OSError) -> str:
    """Say in one line why *address* could not be bound and what to do about it."""
    if error.errno == errno.EADDRINUSE:
        return describe_holder(protocol, address, port)
    if error.errno == errno.EADDRNOTAVAIL:
        return foreign_address(address)
    return f"{protocol} {address}:{port} cannot be opened: {error.strerror}"


def _is_multicast(address: str) -> bool:
    return 224 <= int(address.partition(".")[0]) < 240


def _join(sock: socket.socket, group: str, interface_address: str) -> None:
    membership = socket.inet_aton(group) + socket.inet_aton(interface_address)
    try:
        sock.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, membership)
    except OSError as error:
        if error.errno == errno.ENODEV:
            raise EnvironmentalError(foreign_address(interface_address)) from None
        raise EnvironmentalError(
            f"multicast group {group} cannot be joined at {interface_address}: {error.strerror}"
        ) from None


def _bind_to_interface(sock: socket.socket, interface_address: str) -> None:
    name = interface_of(interface_address)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, name.encode())
