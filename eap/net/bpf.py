"""Classic BPF programs by which the kernel sorts frames between engine and services.

Frame types 2, 3 and 5 are acyclic and go to services; 1, 4 and everything unknown go to the
engine, which counts what it does not know.  Sockets of buses take type 1 alone, those that monitor
subscribers take ARP.
"""

from __future__ import annotations

import ctypes
import socket
import struct
from collections.abc import Iterable, Sequence
from enum import IntEnum
from ipaddress import IPv4Address
from typing import TypeAlias

from eap.codec.arp import ETHERTYPE_ARP
from eap.codec.ethercat import EAP_PORT, ETHERTYPE, FrameType
from eap.errors import EnvironmentalError

SO_ATTACH_FILTER = 26
SO_ATTACH_REUSEPORT_CBPF = 51

Instruction: TypeAlias = tuple[int, int, int, int]
"""Operation, jump if true, jump if false, operand."""


class SocketRole(IntEnum):
    """Process that a socket belongs to: its index in a group of two."""

    ENGINE = 0
    SERVICES = 1


SERVICES_TYPES = (FrameType.AMS, FrameType.RAW_IO, FrameType.MAILBOX)

_LOAD_WORD, _LOAD_HALF, _LOAD_BYTE, _LOAD_SIZE = 0x20, 0x28, 0x30, 0x80
_SHIFT_RIGHT, _RETURN = 0x74, 0x06
_EQUAL, _GREATER, _NOT_LESS, _ANY_BIT = 0x15, 0x25, 0x35, 0x45
# The length of an IPv4 header goes to the index register, and loads behind it add that register.
_LOAD_HEADER_LENGTH, _LOAD_HALF_BEHIND = 0xB1, 0x48
# Loads at negative offsets read what the kernel knows of a packet, not its bytes.
_PACKET_TYPE = 0xFFFFF000 + 4  # SKF_AD_OFF + SKF_AD_PKTTYPE
_ALL = 0x40000
_UDP_HEADER = 8
_ETHERNET_HEADER = 14
_VLAN, _VLAN_TAG = 0x8100, 4
_IPV4 = 0x0800
_FRAGMENT_OFFSET = 0x1FFF
_ARP_SENDER = _ETHERNET_HEADER + 14
_ARP_TARGET = _ETHERNET_HEADER + 24
MAX_ADDRESSES = 1000
"""Addresses of one ARP filter: the kernel takes programs of up to 4096 instructions."""


def _by_type(offset: int, services: int, others: int) -> list[Instruction]:
    """Return *services* or *others* by the type nibble of the frame at *offset*."""
    # Each comparison jumps to the last instruction, so its offset shrinks by one per step.
    types = SERVICES_TYPES
    last = len(types) - 1
    checks: list[Instruction] = [
        (_EQUAL, last - n + 1, 0, frame_type) for n, frame_type in enumerate(types)
    ]
    return [
        (_LOAD_BYTE, 0, 0, offset + 1),
        (_SHIFT_RIGHT, 0, 0, 4),
        *checks,
        (_RETURN, 0, 0, others),
        (_RETURN, 0, 0, services),
    ]


def _actions(role: SocketRole) -> tuple[int, int]:
    return (_ALL, 0) if role is SocketRole.SERVICES else (0, _ALL)


def reuseport_index() -> list[Instruction]:
    """Choose the socket of a SO_REUSEPORT group of two; a datagram too short goes to the engine.

    The kernel ends a program that reads past the end with 0, which is the engine's index.
    """
    return _by_type(0, SocketRole.SERVICES, SocketRole.ENGINE)


def udp_filter(role: SocketRole) -> list[Instruction]:
    """Keep the datagrams of *role*; those too short to have a type are the engine's."""
    short = _ALL if role is SocketRole.ENGINE else 0
    return [
        (_LOAD_SIZE, 0, 0, 0),
        # A load beyond the end ends the program with 0, which drops the datagram: the engine would
        # not count it.
        (_NOT_LESS, 1, 0, _UDP_HEADER + 2),
        (_RETURN, 0, 0, short),
        *_by_type(_UDP_HEADER, *_actions(role)),
    ]


def packet_filter(role: SocketRole) -> list[Instruction]:
    """Keep EtherCAT frames of *role* that are addressed to this host or to a group.

    The kernel has taken a VLAN tag out before the program runs.
    """
    return [
        (_LOAD_HALF, 0, 0, 12),
        (_EQUAL, 1, 0, ETHERTYPE),
        (_RETURN, 0, 0, 0),
        (_LOAD_WORD, 0, 0, _PACKET_TYPE),
        # PACKET_HOST, BROADCAST and MULTICAST are 0 to 2: what is above is a frame to another host,
        # which a promiscuous interface shows too.
        (_GREATER, 0, 1, socket.PACKET_MULTICAST),
        (_RETURN, 0, 0, 0),
        *_by_type(_ETHERNET_HEADER, *_actions(role)),
    ]


def type1_filter() -> list[Instruction]:
    """Keep EtherCAT frames of type 1 to any destination."""
    return [
        (_LOAD_HALF, 0, 0, 12),
        (_EQUAL, 1, 0, ETHERTYPE),
        (_RETURN, 0, 0, 0),
        (_LOAD_BYTE, 0, 0, _ETHERNET_HEADER + 1),
        (_SHIFT_RIGHT, 0, 0, 4),
        (_EQUAL, 0, 1, FrameType.DATAGRAM),
        (_RETURN, 0, 0, _ALL),
        (_RETURN, 0, 0, 0),
    ]


def capture_filter() -> list[Instruction]:
    """Keep EtherCAT frames to anyone, and UDP over IPv4 from or to port 34980, tagged or not.

    Of a datagram in fragments the first one is kept: the others have no port numbers.
    """
    program: list[Instruction] = []
    # The kernel has taken out the tag of a received packet; one that this host sends still has it.
    for tag in (0, _VLAN_TAG):
        start = _ETHERNET_HEADER + tag
        part: list[Instruction] = [
            (_LOAD_HALF, 0, 0, start - 2),
            (_EQUAL, 0, 1, ETHERTYPE),
            (_RETURN, 0, 0, _ALL),
            (_EQUAL, 0, 10, _IPV4),
            (_LOAD_BYTE, 0, 0, start + 9),
            (_EQUAL, 0, 8, socket.IPPROTO_UDP),
            (_LOAD_HALF, 0, 0, start + 6),
            (_ANY_BIT, 6, 0, _FRAGMENT_OFFSET),
            (_LOAD_HEADER_LENGTH, 0, 0, start),
            (_LOAD_HALF_BEHIND, 0, 0, start),
            (_EQUAL, 2, 0, EAP_PORT),
            (_LOAD_HALF_BEHIND, 0, 0, start + 2),
            (_EQUAL, 0, 1, EAP_PORT),
            (_RETURN, 0, 0, _ALL),
            (_RETURN, 0, 0, 0),
        ]
        program += part
        if not tag:
            # Behind the first part: only a tagged packet goes on.
            program[-1:] = [(_LOAD_HALF, 0, 0, 12), (_EQUAL, 1, 0, _VLAN), (_RETURN, 0, 0, 0)]
    return program


def arp_filter(addresses: Iterable[IPv4Address]) -> list[Instruction]:
    """Keep ARP messages from *addresses*, and probes for them.

    Raises:
        EnvironmentalError: there are more than MAX_ADDRESSES.
    """
    wanted = sorted(set(addresses))
    if len(wanted) > MAX_ADDRESSES:
        raise EnvironmentalError(
            f"{len(wanted)} addresses to monitor on one interface, at most {MAX_ADDRESSES} can be"
        )
    program: list[Instruction] = [
        (_LOAD_HALF, 0, 0, 12),
        (_EQUAL, 1, 0, ETHERTYPE_ARP),
        (_RETURN, 0, 0, 0),
        (_LOAD_WORD, 0, 0, _ARP_SENDER),
        (_EQUAL, 0, 1, 0),
        (_LOAD_WORD, 0, 0, _ARP_TARGET),
    ]
    for address in wanted:
        # A return of its own for each address: a jump over more than 255 instructions does not fit.
        program += [(_EQUAL, 0, 1, int(address)), (_RETURN, 0, 0, _ALL)]
    return [*program, (_RETURN, 0, 0, 0)]


def attach(
    sock: socket.socket, program: Sequence[Instruction], option: int = SO_ATTACH_FILTER
) -> None:
    """Attach *program* to *sock*; raise OSError if the kernel rejects it."""
    code = b"".join(struct.pack("@HBBI", *instruction) for instruction in program)
    # The kernel copies the program during the call, so the memory may go afterwards.
    memory = ctypes.create_string_buffer(code, len(code))
    fprog = struct.pack("@HP", len(program), ctypes.addressof(memory))
    sock.setsockopt(socket.SOL_SOCKET, option, fprog)
