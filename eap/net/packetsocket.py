"""Opening AF_PACKET sockets: for EAP a pair, the engine's and that of services; for a bus one.

One more, for services, is for ARP where subscribers are monitored.
"""

from __future__ import annotations

import os
import shlex
import socket
import struct
import sys
from collections.abc import Sequence
from time import monotonic_ns

from eap.codec.ethercat import ETHERTYPE
from eap.errors import EnvironmentalError
from eap.ids import MacAddr
from eap.net import bpf
from eap.net.interface import check_interface, is_switched_on
from eap.net.ipsocket import prepare_receiver

SOL_PACKET = 263
PACKET_ADD_MEMBERSHIP = 1
PACKET_AUXDATA = 8
PACKET_IGNORE_OUTGOING = 23
PACKET_MR_MULTICAST = 0
PACKET_MR_PROMISC = 1
ARPHRD_LOOPBACK = 772
_ETH_P_ALL = 3
_ARPHRD_ETHER = 1


def open_packet_pair(interface: str) -> tuple[socket.socket, socket.socket]:
    """Open *interface* for EtherType 0x88A4 and let the kernel sort what arrives by frame type.

    The socket is bound to all protocols and filtered, because only then the kernel reports the VLAN
    of a frame.

    Returns:
        The engine's socket and that of services.

    Raises:
        EnvironmentalError: the interface is missing, down or no Ethernet, or CAP_NET_RAW is.
    """
    check_interface(interface)
    engine = _open(interface, bpf.packet_filter(bpf.SocketRole.ENGINE))
    try:
        return engine, _open(interface, bpf.packet_filter(bpf.SocketRole.SERVICES))
    except BaseException:
        engine.close()
        raise


def open_type1(interface: str, *, group: bytes = b"") -> socket.socket:
    """Open *interface* for frames of type 1, which the kernel picks out.

    Args:
        interface: Its name.
        group: The multicast address to join; without one the interface is promiscuous.

    Raises:
        EnvironmentalError: the interface is missing, down or no Ethernet, or CAP_NET_RAW is.
    """
    check_interface(interface)
    sock = _closed_socket(interface)
    try:
        bpf.attach(sock, bpf.type1_filter())
        join_type1(sock, interface, group)
    except (OSError, EnvironmentalError) as error:
        sock.close()
        raise _explain(interface, error) from None
    return sock


def join_type1(sock: socket.socket, interface: str, group: bytes) -> None:
    """Bind a socket of :func:`open_type1`, also again to an interface that was recreated.

    Raises:
        OSError: the interface is not there.
        EnvironmentalError: it is no Ethernet.
    """
    _join(sock, interface, ETHERTYPE)
    # Slaves process frames to any destination, so a simulated segment has to see all of them.
    kind = PACKET_MR_MULTICAST if group else PACKET_MR_PROMISC
    index = socket.if_nametoindex(interface)
    membership = struct.pack("iHH8s", index, kind, len(group), group)
    sock.setsockopt(SOL_PACKET, PACKET_ADD_MEMBERSHIP, membership)


def open_arp(interface: str) -> socket.socket:
    """Open *interface* for ARP: nothing is received until a prober watches addresses.

    Raises:
        EnvironmentalError: the interface is missing, down or no Ethernet, or CAP_NET_RAW is.
    """
    check_interface(interface)
    return _open(interface, bpf.arp_filter(()))


LOOK_NS = 50_000_000
"""Interval between two looks for an interface that is away."""
_NO_MAC = MacAddr(bytes(6))


class InterfaceBinding:
    """Interface of a socket of :func:`open_packet_pair` or :func:`open_arp`, found again by name.

    A packet socket is bound to the index of its interface.  An interface that is deleted and made
    again under the same name has another index, mostly another address, and no memberships.  The
    kernel reports the loss once, by ENETDOWN: the owner sets :attr:`is_lost` then, and calls
    :meth:`find` from time to time.

    Args:
        sock: The socket.
        name: Name of the interface; by default the one that it is bound to.

    Attributes:
        name: Name of the interface.
        address: Own address there; zero as long as it was never seen.
        is_lost: True if the interface is down or deleted, as far as the owner knows.
    """

    def __init__(self, sock: socket.socket, name: str = "") -> None:
        bound = sock.getsockname()
        self.name: str = name or bound[0]
        self.is_lost = bound[0] != self.name  # it went while the owner did not run
        self.address = _NO_MAC if self.is_lost else MacAddr(bound[4])
        self._sock = sock
        self._groups: list[bytes] = []
        self._look_at_ns = 0

    def join(self, group: bytes) -> None:
        """Receive frames to a multicast MAC address, also after the interface was made again.

        Raises:
            OSError: the interface does not take it.
        """
        if group in self._groups:
            return
        self._groups.append(group)
        if not self.is_lost:
            self._add_membership(group)

    def find(self) -> bool:
        """Look for a lost interface; return whether another one was found and joined.

        The name is looked up at most once each LOOK_NS, other calls return at once.
        """
        now_ns = monotonic_ns()
        if not self.is_lost or now_ns < self._look_at_ns:
            return False
        self._look_at_ns = now_ns + LOOK_NS
        try:
            if self._sock.getsockname()[0] == self.name:
                # It was only switched off: the kernel goes on by itself once it is on.
                self.is_lost = not is_switched_on(self.name)
                return False
            _join(self._sock, self.name, _ETH_P_ALL)
            self.address = MacAddr(self._sock.getsockname()[4])
            for group in self._groups:
                self._add_membership(group)
        except (OSError, ValueError, EnvironmentalError):
            return False  # not there yet, gone again meanwhile, or no Ethernet
        self.is_lost = not is_switched_on(self.name)
        return True

    def _add_membership(self, group: bytes) -> None:
        # Without it the network adapter filters the group out before any socket sees it.
        index = socket.if_nametoindex(self.name)
        membership = struct.pack("@iHH8s", index, PACKET_MR_MULTICAST, len(group), group)
        self._sock.setsockopt(SOL_PACKET, PACKET_ADD_MEMBERSHIP, membership)


def open_capture(interface: str, program: Sequence[bpf.Instruction]) -> socket.socket:
    """Open *interface* to see what *program* picks out of all that it receives and sends.

    The loopback interface shows each packet once, as received.

    Raises:
        EnvironmentalError: the interface is missing, down or no Ethernet, or CAP_NET_RAW is.
    """
    check_interface(interface)
    sock = _closed_socket(interface, instead="")
    try:
        bpf.attach(sock, program)
        sock.setsockopt(SOL_PACKET, PACKET_AUXDATA, 1)
        prepare_receiver(sock)
        sock.bind((interface, 0))  # receives nothing yet: tells the kind of the interface
        is_loopback = sock.getsockname()[3] == ARPHRD_LOOPBACK
        _bind_ethernet(sock, interface, _ETH_P_ALL, ignore_outgoing=is_loopback)
        # Frames between others are seen too: at a mirror port, and groups that nobody here joined.
        index = socket.if_nametoindex(interface)
        membership = struct.pack("iHH8s", index, PACKET_MR_PROMISC, 0, b"")
        sock.setsockopt(SOL_PACKET, PACKET_ADD_MEMBERSHIP, membership)
    except (OSError, EnvironmentalError) as error:
        sock.close()
        raise _explain(interface, error) from None
    return sock


def _open(interface: str, program: Sequence[bpf.Instruction]) -> socket.socket:
    sock = _closed_socket(interface)
    try:
        bpf.attach(sock, program)
        sock.setsockopt(SOL_PACKET, PACKET_AUXDATA, 1)
        prepare_receiver(sock)
        _join(sock, interface, _ETH_P_ALL)
    except (OSError, EnvironmentalError) as error:
        sock.close()
        raise _explain(interface, error) from None
    return sock


_BY_UDP = "; or use udp://ADDRESS, which needs no privilege"


def _closed_socket(interface: str, *, instead: str = _BY_UDP) -> socket.socket:
    """Return a socket of protocol 0: no foreign frame gets in before its filter is in place."""
    try:
        return socket.socket(socket.AF_PACKET, socket.SOCK_RAW, 0)
    except PermissionError:
        raise EnvironmentalError(missing_capability(interface, instead=instead)) from None


def _join(sock: socket.socket, interface: str, protocol: int) -> None:
    # Without it the socket also receives the frames that this host sends.
    _bind_ethernet(sock, interface, protocol, ignore_outgoing=True)


def _bind_ethernet(
    sock: socket.socket, interface: str, protocol: int, *, ignore_outgoing: bool
) -> None:
    sock.setsockopt(SOL_PACKET, PACKET_IGNORE_OUTGOING, int(ignore_outgoing))
    sock.bind((interface, protocol))
    if sock.getsockname()[3] not in (_ARPHRD_ETHER, ARPHRD_LOOPBACK):
        raise EnvironmentalError(f"interface {interface} is not an Ethernet interface")


def _explain(interface: str, error: OSError | EnvironmentalError) -> EnvironmentalError:
    if isinstance(error, EnvironmentalError):
        return error
    return EnvironmentalError(f"interface {interface}: {error.strerror}")


def missing_capability(interface: str, *, instead: str = _BY_UDP) -> str:
    """Return in one line what opening *interface* needs and how to get it for this run only.

    *instead* is what works without it.
    """
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
    return f"{start}; {cure}{instead}"
