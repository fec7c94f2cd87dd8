"""A tap at an interface: what leaves it and what comes, in order, with the kernel's times."""

from __future__ import annotations

import socket
import struct
from dataclasses import dataclass
from types import TracebackType
from typing import Self

from eap.codec.ethercat import FrameType
from eap.codec.pd import PD_FRAME_START, PdFrameHeader, iter_pds
from eap.recording.packets import unwrap

_ALL = 3  # ETH_P_ALL; taps for one EtherType are not shown what leaves
_OUTGOING = 4
_SO_TIMESTAMPNS = 35
_SO_RCVBUFFORCE = 33


@dataclass(frozen=True)
class Tapped:
    """One frame of process data that passed an interface; addresses are those of its transport."""

    frame: bytes
    at_ns: int
    leaves: bool
    source: str
    destination: str

    @property
    def header(self) -> PdFrameHeader:
        return PdFrameHeader.decode(self.frame, PD_FRAME_START)

    @property
    def pd_ids(self) -> list[int]:
        return [header.pd_id for header, _ in iter_pds(self.frame)]


class Wiretap:
    """Keeps what passes *interface* in the namespace that the packet socket *sock* is of."""

    def __init__(self, sock: socket.socket, interface: str) -> None:
        sock.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
        try:
            sock.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, 8 << 20)
        except PermissionError:  # root of a user namespace
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 8 << 20)
        sock.bind((interface, _ALL))
        sock.setblocking(False)
        self._sock = sock
        self._tapped: list[Tapped] = []

    def tapped(self) -> list[Tapped]:
        """Return all frames of type 4 so far, oldest first."""
        while True:
            try:
                octets, ancillary, _, address = self._sock.recvmsg(4096, 64)
            except BlockingIOError:
                return sorted(self._tapped, key=lambda passed: passed.at_ns)
            packet = unwrap(octets)
            if packet is None or packet.payload[1] >> 4 != FrameType.PROCESS_DATA:
                continue  # routers ask each other whether they are alive, by type 5
            seconds, rest = struct.unpack("@qq", ancillary[0][2])
            at_ns = seconds * 1_000_000_000 + rest
            leaves = address[2] == _OUTGOING
            self._tapped.append(
                Tapped(packet.payload, at_ns, leaves, packet.source, packet.destination)
            )

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        value: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._sock.close()
