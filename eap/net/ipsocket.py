"""Opening of UDP and TCP sockets by the supervisor, which keeps them for its child processes.

The EAP sockets of an address are a pair, one for the engine and one for services.  The index of a
socket in its SO_REUSEPORT group follows the order of binding and changes when a member closes.  So
no other process binds, and nothing is closed while the appliance runs.

A machine may have an AMS router of its own, such as that of a PLC run-time.  The error for a taken
port names the process that holds it, and how to run the station without AMS.
"""

from __future__ import annotations

import errno
import logging
import socket
import struct
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from ipaddress import IPv4Address
from pathlib import Path

from eap.codec.ams import AMS_TCP_PORT
from eap.codec.amsdiscovery import AMS_UDP_PORT
from eap.codec.ethercat import EAP_PORT
from eap.errors import EnvironmentalError
from eap.net import bpf
from eap.net.interface import broadcast_of, foreign_address, interface_of, own_addresses
from eap.net.mmsg import SO_TIMESTAMPNS

SO_RCVBUFFORCE = 33
IP_MULTICAST_ALL = 49
_RECEIVE_BUFFER = 8 << 20
_BACKLOG = 512
"""Connections that the kernel keeps until they are accepted: a crowd must not hide a client."""


def open_udp_pair(address: str, port: int = EAP_PORT) -> tuple[socket.socket, socket.socket]:
    """Bind *address* twice and let the kernel sort what arrives by frame type.

    Returns:
        The engine's socket, which also sends, and that of services.

    Raises:
        EnvironmentalError: another process holds the port, or the address is not this machine's.
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
        # Before the second socket joins: the kernel would spread datagrams by a hash in between.
        bpf.attach(engine, bpf.reuseport_index(), bpf.SO_ATTACH_REUSEPORT_CBPF)
        _bind(services, address, port)
        if address != "0.0.0.0":  # noqa: S104  a comparison
            out = socket.inet_aton(address)
            engine.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, out)
        # Process data does not leave the local network.
        engine.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, 1)
        # Stations of one host may subscribe to each other's groups.
        engine.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_LOOP, 1)
    except BaseException:
        _close(pair)
        raise
    return pair


def open_tcp_listener(address: str, port: int = EAP_PORT) -> socket.socket:
    """Return a socket that listens on *address*.

    Raises:
        EnvironmentalError: another process holds the port, or the address is not this machine's.
    """
    sock = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    try:
        # Connections in TIME_WAIT of an appliance that has ended must not prevent a new start.
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        sock.bind((address, port))
        sock.listen(_BACKLOG)
    except OSError as error:
        sock.close()
        raise EnvironmentalError(bind_failure("TCP", address, port, error)) from None
    return sock


def open_udp_receiver(address: str, port: int) -> socket.socket:
    """Return a socket that is bound to *address*, for one process alone.

    Raises:
        EnvironmentalError: another process holds the port, or the address is not this machine's.
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
        for role, sock in zip(bpf.SocketRole, pair, strict=True):
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            prepare_receiver(sock)
            bpf.attach(sock, bpf.udp_filter(role))
            if _is_multicast(group):
                # By default a socket gets the groups that any socket of the host has joined at any
                # interface.
                sock.setsockopt(socket.IPPROTO_IP, IP_MULTICAST_ALL, 0)
            else:
                # A broadcast address is the same on all interfaces, and has no membership to limit
                # it to one.
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
        # FORCE goes beyond net.core.rmem_max and takes CAP_NET_ADMIN; without it the limit applies.
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
    """Return in one line why *address* could not be bound and what to do about it."""
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


class AddressKeeper:
    """Holds what sockets have at the interfaces of local addresses, also when these are made again.

    An address that went and came back serves its sockets again by itself.  Memberships, outgoing
    interfaces and bindings to an interface are kept by its index, which is another one then.

    Args:
        notify: Called when there is something to keep.
    """

    def __init__(self, notify: Callable[[], object] = int) -> None:
        self._notify = notify
        self._indexes: dict[str, int] = {}
        self._renewals: dict[str, list[tuple[socket.socket, Callable[[int], None]]]] = {}

    def keep_group(self, sock: socket.socket, group: str, address: str) -> None:
        """Keep *sock* in a multicast group, or at the broadcast address, at the interface."""
        if _is_multicast(group):
            self._keep(sock, address, lambda before: _join_again(sock, group, address, before))
        else:
            self.keep_interface(sock, address)

    def keep_interface(self, sock: socket.socket, address: str) -> None:
        """Keep *sock* bound to the interface."""
        self._keep(sock, address, lambda before: _bind_again(sock, address))

    def keep_outgoing(self, sock: socket.socket, address: str) -> None:
        """Let *sock* send multicast at the interface."""
        out = socket.inet_aton(address)
        self._keep(
            sock,
            address,
            lambda before: sock.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, out),
        )

    def forget(self, sock: socket.socket) -> None:
        """Keep nothing for *sock* any more, which is closed next."""
        for address, renewals in list(self._renewals.items()):
            renewals[:] = [each for each in renewals if each[0] is not sock]
            if not renewals:
                del self._renewals[address]
                self._indexes.pop(address, None)

    def look(self) -> None:
        """Renew what belongs to interfaces that were made again since the last call."""
        if not self._renewals:
            return
        names = {address: label.partition(":")[0] for label, address in own_addresses()}
        for address, renewals in self._renewals.items():
            index = _index_of(names.get(address, ""))
            before = self._indexes.get(address, 0)
            if not index or index == before:
                continue
            self._indexes[address] = index
            for _, renew in renewals:
                try:
                    renew(before)
                except (OSError, EnvironmentalError) as exc:
                    logger.warning("%s: its interface was made again: %s", address, exc)

    @property
    def is_empty(self) -> bool:
        """True if there is nothing to keep."""
        return not self._renewals

    def _keep(self, sock: socket.socket, address: str, renew: Callable[[int], None]) -> None:
        if IPv4Address(address).is_loopback:  # that interface is never deleted
            return
        self._renewals.setdefault(address, []).append((sock, renew))
        self._notify()


def _index_of(name: str) -> int:
    try:
        return socket.if_nametoindex(name) if name else 0
    except OSError:
        return 0  # it has just gone


def _join_again(sock: socket.socket, group: str, address: str, before: int) -> None:
    if before:
        # The membership of the deleted interface would count against the limit of the kernel.
        old = struct.pack("@4s4xi", socket.inet_aton(group), before)
        with suppress(OSError):
            sock.setsockopt(socket.IPPROTO_IP, socket.IP_DROP_MEMBERSHIP, old)
    membership = socket.inet_aton(group) + socket.inet_aton(address)
    try:
        sock.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, membership)
    except OSError as error:
        if error.errno != errno.EADDRINUSE:  # it is still a member
            raise


def _bind_again(sock: socket.socket, address: str) -> None:
    name = interface_of(address)
    bound = b""
    with suppress(OSError):  # ENODEV: the interface was deleted
        bound = sock.getsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, 16).rstrip(b"\0")
    if bound == name.encode():
        return
    try:
        _bind_to_interface(sock, address)
    except PermissionError:
        # An ordinary user may bind a socket once.
        reason = "a second binding needs CAP_NET_RAW: restart the appliance"
        raise EnvironmentalError(f"broadcasts at {name} are not received: {reason}") from None


_PROC = Path("/proc")
_SHOWN = 80
"""Characters of a command in a message."""
_OWN_COMMANDS = ("eapctl", "-m eap")


@dataclass(frozen=True, slots=True)
class Holder:
    """A socket that occupies a port, and its process where that is visible."""

    local: str
    remote: str
    """Address it is connected to, empty if it is not."""
    pid: int = 0
    command: str = ""

    def __str__(self) -> str:
        if not self.pid:
            return "an unknown process"
        short = " ".join(word.rpartition("/")[2] or word for word in self.command.split())
        return f"process {self.pid} ({short[:_SHOWN]})"


def find_holders(protocol: str, address: str, port: int, *, proc: Path = _PROC) -> list[Holder]:
    """Return the sockets of *protocol* (``UDP`` or ``TCP``) that prevent binding *address*.

    Raises nothing: what this user may not see is left out.
    """
    holders = []
    # A socket of IPv6 at :: takes the port of IPv4 too, and is listed only in the other table.
    for name in (protocol.lower(), protocol.lower() + "6"):
        try:
            lines = (proc / "net" / name).read_text().splitlines()[1:]
        except OSError:
            continue
        for line in lines:
            fields = line.split()
            local, local_port = _parse(fields[1])
            wild = "0.0.0.0"  # noqa: S104  a comparison
            if local_port != port or (local != address and wild not in {local, address}):
                continue
            remote, remote_port = _parse(fields[2])
            pid, command = _find_process(fields[9], proc)
            peer = f"{remote}:{remote_port}" if remote_port else ""
            holders.append(Holder(f"{local}:{local_port}", peer, pid, command))
    return holders


def describe_holder(protocol: str, address: str, port: int, *, proc: Path = _PROC) -> str:
    """Return one line that names the holder of the port, and the remedy."""
    start = f"{protocol} {address}:{port} is in use"
    holders = find_holders(protocol, address, port, proc=proc)
    if not holders:
        return f"{start} by an unknown process: `ss -lnp` as root shows it"
    holder = min(holders, key=lambda found: bool(found.remote))  # a server before its clients
    text = f"{start} by {holder}"
    if any(own in holder.command for own in _OWN_COMMANDS):
        return f"{text}: stop that appliance or give this one another address"
    if not _is_ephemeral(port, proc):
        return f"{text}: stop it or choose another address"
    what = f", a client connected to {holder.remote}" if holder.remote else ""
    return (
        f"{text}{what}; clients get any port of {_range(proc)[0]} to {_range(proc)[1]}: end it, "
        f"and keep the port free with `sysctl -w net.ipv4.ip_local_reserved_ports={port}`"
    )


def _parse(text: str) -> tuple[str, int]:
    """Read ``0100007F:88A4``, or the 32 digits of IPv6 if they stand for an IPv4 address."""
    digits, _, port = text.partition(":")
    words = [int(digits[n : n + 8], 16) for n in range(0, len(digits), 8)]
    if len(words) == 4 and any(words[:2]):
        return digits, int(port, 16)
    return socket.inet_ntoa(struct.pack("@I", words[-1])), int(port, 16)


def _find_process(inode: str, proc: Path) -> tuple[int, str]:
    wanted = f"socket:[{inode}]"
    for process in proc.iterdir():
        if not process.name.isdigit():
            continue
        try:
            if any(str(link.readlink()) == wanted for link in (process / "fd").iterdir()):
                command = (process / "cmdline").read_bytes().decode(errors="replace")
                return int(process.name), command.replace("\0", " ").strip()
        except OSError:
            continue
    return 0, ""


def _range(proc: Path) -> tuple[int, int]:
    low, high = (proc / "sys/net/ipv4/ip_local_port_range").read_text().split()
    return int(low), int(high)


def _is_ephemeral(port: int, proc: Path) -> bool:
    """Return whether *port* is in the range of ephemeral ports of clients."""
    try:
        low, high = _range(proc)
        reserved = (proc / "sys/net/ipv4/ip_local_reserved_ports").read_text().strip()
    except OSError:
        return False
    if not low <= port <= high:
        return False
    spans = [part.partition("-") for part in reserved.split(",") if part]
    return not any(int(first) <= port <= int(last or first) for first, _, last in spans)


_WITHOUT = "; without AMS at this address the station runs too: `ams: false` at its EAP ports there"

logger = logging.getLogger(__name__)


def open_ams_listener(address: str) -> socket.socket:
    """Return a socket that listens on *address* for AMS/TCP.

    Raises:
        EnvironmentalError: another process holds the port, or the address is not this machine's.
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
