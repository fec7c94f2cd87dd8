"""A witness on the wire: which frames passed, and when, by the kernel's clock."""

from __future__ import annotations

import itertools
import socket
import struct
from dataclasses import dataclass
from types import TracebackType
from typing import Self

from eap.codec.ethercat import EAP_PORT, ETHERTYPE
from eap.codec.pd import PD_FRAME_START, PdFrameHeader

_SO_TIMESTAMPNS = 35
_SO_RCVBUFFORCE = 33


@dataclass(frozen=True)
class LoopDetector:
    """One frame of process data, from its EtherCAT header on."""

    frame: bytes
    at_ns: int

    @property
    def header(self) -> PdFrameHeader:
        return PdFrameHeader.decode(self.frame, PD_FRAME_START)


class Listener:
    """Keeps what arrives at a bound socket; *skip* octets stand before the EtherCAT header."""

    def __init__(self, sock: socket.socket, skip: int = 0) -> None:
        sock.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
        try:
            sock.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, 4 << 20)
        except PermissionError:
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4 << 20)
        sock.setblocking(False)
        self._sock = sock
        self._skip = skip
        self._seen: list[LoopDetector] = []

    def seen(self) -> list[LoopDetector]:
        """Return all so far, oldest first."""
        while True:
            try:
                data, ancillary, _, _ = self._sock.recvmsg(2048, 64)
            except BlockingIOError:
                return self._seen
            seconds, rest = struct.unpack("@qq", ancillary[0][2])
            self._seen.append(LoopDetector(data[self._skip :], seconds * 1_000_000_000 + rest))

    def cycles(self) -> list[int]:
        """Return the cycle counters so far, without their wrapping."""
        counters = [passed.header.cycle for passed in self.seen()]
        steps = ((b - a) & 0xFFFF for a, b in itertools.pairwise(counters))
        return list(itertools.accumulate(steps, initial=counters[0])) if counters else []

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        value: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._sock.close()


def listen_to_group(group: str, interface_address: str) -> Listener:
    """Listen to a multicast group beside whoever else does."""
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    sock.bind((group, EAP_PORT))
    membership = socket.inet_aton(group) + socket.inet_aton(interface_address)
    sock.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, membership)
    return Listener(sock)


def listen_to_interface(sock: socket.socket, name: str = "eth0") -> Listener:
    """Listen to our EtherType with a packet socket that is not bound yet."""
    sock.bind((name, ETHERTYPE))
    return Listener(sock, skip=14)
