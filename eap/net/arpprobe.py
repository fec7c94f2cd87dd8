"""The ARP driver: asks who has an IPv4 address on one Ethernet interface, as RFC 5227 asks.

The interface needs no IPv4 address of its own, and the machine's neighbour table is not involved.
Its socket comes from :func:`eap.net.packetsocket.open_arp`.
"""

from __future__ import annotations

import socket
import struct
from collections.abc import Iterable
from ipaddress import IPv4Address
from typing import NamedTuple

from eap.codec import arp
from eap.errors import CodecError, EnvironmentalError
from eap.ids import BROADCAST_MAC, MacAddr
from eap.net import bpf
from eap.net.ethernet import ETHERNET_HEADER, MINIMUM_SIZE
from eap.net.interface import interface_of
from eap.net.mmsg import count_error
from eap.net.packetsocket import ARPHRD_LOOPBACK, PACKET_AUXDATA, SOL_PACKET

_TPID = 0x8100
_VID = 0x0FFF
_AUXDATA = struct.Struct("@IIIHHHH")  # status, sizes, offsets, TCI, TPID
_CONTROL_SIZE = 128  # room for the time stamp of every packet socket, too
_FRAMES_PER_DRAIN = 256


class Heard(NamedTuple):
    """An ARP message about a watched address."""

    address: IPv4Address
    mac: MacAddr
    """Who sent it."""
    is_claim: bool
    """False: it has the address.  True: it checks whether it may take it (RFC 5227 2.1.1)."""


class ArpProber:
    """Asks and listens in one VLAN of an interface; 0 is untagged.  It never waits.

    Attributes:
        errors: Failed system calls by errno name, and messages that made no sense.
    """

    def __init__(self, sock: socket.socket, *, vlan_id: int = 0, priority: int = 0) -> None:
        sock.setblocking(False)
        self.errors: dict[str, int] = {}
        self.interface, _, _, self._kind, hardware = sock.getsockname()
        self.mac = MacAddr(hardware)
        self._sock = sock
        self._vlan_id = vlan_id
        tag = priority << 13 | vlan_id
        head = BROADCAST_MAC + self.mac + (struct.pack("!HH", _TPID, tag) if tag else b"")
        self._head = head + struct.pack("!H", arp.ETHERTYPE_ARP)
        self._watched: frozenset[IPv4Address] = frozenset()

    def watch(self, addresses: Iterable[IPv4Address]) -> None:
        """Hear of *addresses* from now on, and of no others.

        Raises:
            EnvironmentalError: they are more than a filter or the kernel has room for.
        """
        wanted = frozenset(addresses)
        try:
            bpf.attach(self._sock, bpf.arp_filter(wanted))
        except OSError as error:
            raise EnvironmentalError(
                f"interface {self.interface}: {len(wanted)} addresses cannot be monitored: "
                f"{error.strerror} (`sysctl net.core.optmem_max` is what one socket may take)"
            ) from None
        self._watched = wanted

    def probe(self, address: IPv4Address) -> bool:
        """Ask who has *address*; return whether an answer can be expected at all.

        It cannot for addresses of this machine, which hears no question of its own, on the loopback
        interface, where nobody answers ARP, and where the kernel did not send.
        """
        if self._kind == ARPHRD_LOOPBACK or _is_own(address):
            return False
        message = arp.ArpMessage.probe(self.mac, address).encode()
        try:
            self._sock.send((self._head + message).ljust(MINIMUM_SIZE, b"\0"))
        except OSError as error:
            count_error(self.errors, error.errno)
            return False
        return True

    def drain(self) -> list[Heard]:
        """Return what was heard of the watched addresses, from at most 256 frames."""
        found: list[Heard] = []
        for _ in range(_FRAMES_PER_DRAIN):
            try:
                data, control, _, _ = self._sock.recvmsg(ETHERNET_HEADER + arp.SIZE, _CONTROL_SIZE)
            except BlockingIOError:
                break
            except OSError as error:
                count_error(self.errors, error.errno)
                break
            if _vlan_of(control) == self._vlan_id and (heard := self._parse(data)):
                found.append(heard)
        return found

    def fileno(self) -> int:
        """Return the descriptor that becomes readable when a message waits."""
        return self._sock.fileno()

    def close(self) -> None:
        """Close the socket."""
        self._sock.close()

    def _parse(self, data: bytes) -> Heard | None:
        try:
            message = arp.ArpMessage.decode(data, ETHERNET_HEADER)
        except CodecError:
            self.errors["malformed"] = self.errors.get("malformed", 0) + 1
            return None
        if message.sender_mac == self.mac:
            return None
        address = message.target if message.is_probe else message.sender
        if address not in self._watched or not (message.is_probe or message.shows_sender):
            return None
        return Heard(address, message.sender_mac, message.is_probe)


def _is_own(address: IPv4Address) -> bool:
    try:
        interface_of(str(address))
    except EnvironmentalError:
        return False
    return True


def _vlan_of(control: list[tuple[int, int, bytes]]) -> int:
    for level, kind, data in control:
        if (level, kind) == (SOL_PACKET, PACKET_AUXDATA):
            return int(_AUXDATA.unpack_from(data)[5]) & _VID
    return 0
