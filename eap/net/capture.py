"""Capture of EAP frames at one interface, beside whatever else uses it.

The socket takes a copy of what the interface receives and sends; nothing is taken from others and
nothing is sent.  CAP_NET_RAW is all that it needs.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import TypeAlias

from eap.net import bpf
from eap.net.mmsg import BATCH, ReceiveBatch, note_receive_error
from eap.net.packetsocket import SOL_PACKET, open_capture

_CONTROL_SIZE = 72  # a time stamp, then the auxiliary data of a packet
_TCI = 32  # of the 36 half words
_PACKET_STATISTICS = 6
_BATCHES = 16
"""Batches of one call: the caller wants to redraw its screen now and then."""

PacketHandler: TypeAlias = Callable[[memoryview, int, int], None]
"""Handler of one packet: ``handle(octets, at_ns, tci)``.

*octets* starts at the Ethernet header, without a VLAN tag that the kernel took out: that is *tci*,
0 for none.  *at_ns* is the kernel's time on the monotonic clock.  The view is valid in the call.
"""


class FrameCapture:
    """One AF_PACKET socket that sees EtherType 0x88A4 and UDP port 34980.

    Attributes:
        errors: Failed system calls by errno name.
    """

    def __init__(self, interface: str) -> None:
        """Open the capture at *interface*.

        Raises:
            EnvironmentalError: it is missing, down or no Ethernet, or CAP_NET_RAW is missing.
        """
        self._sock = open_capture(interface, bpf.capture_filter())
        self._sock.setblocking(False)
        self._batch = ReceiveBatch(_CONTROL_SIZE, 0, with_senders=False)
        self._receive = self._batch.reader(self._sock.fileno())
        self._tags = self._batch.control.cast("H")
        self._dropped = 0
        self.errors: dict[str, int] = {}

    def drain(self, handle: PacketHandler) -> int:
        """Hand over what waits, at most some batches; return how many packets those were."""
        total = 0
        for _ in range(_BATCHES):
            count = self._receive()
            if count < 0:
                note_receive_error(self.errors)
                break
            tags = self._tags[_TCI : count * _CONTROL_SIZE // 2 : _CONTROL_SIZE // 2].tolist()
            sizes, times = self._batch.arrivals(count) if count else ([], [])
            for view, size, at_ns, tci in zip(self._batch.views, sizes, times, tags, strict=False):
                handle(view[:size], at_ns, tci)
            total += count
            if count < BATCH:
                break
        return total

    @property
    def dropped(self) -> int:
        """Packets that the kernel dropped so far because they were not read in time."""
        # The kernel counts from the last reading on.
        octets = self._sock.getsockopt(SOL_PACKET, _PACKET_STATISTICS, 8)
        self._dropped += struct.unpack("II", octets)[1]
        return self._dropped

    def fileno(self) -> int:
        """Return the descriptor that becomes readable when a packet waits."""
        return self._sock.fileno()

    def close(self) -> None:
        """Close the socket."""
        self._sock.close()
