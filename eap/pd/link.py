"""What the cyclic core asks of a network: the one seam between ``eap.pd`` and ``eap.net``."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol, TypeAlias

Taker: TypeAlias = Callable[[memoryview, int, int], None]
"""Takes one frame: ``take(data, size, at_ns)``.

*data* starts at the EtherCAT header and may be longer than the frame; *size* octets of it arrived.
*at_ns* is the kernel's receive time on the monotonic clock.  The view is valid during the call.
"""


class OutFrame:
    """One frame ready to go: the octets that a channel puts on its wire, patched in place.

    *buffer* holds *headroom* octets that belong to the channel (an Ethernet header, or nothing),
    then the EtherCAT frame, then padding.  A channel may cache whatever it derives from the
    object: buffer and destination never change, only the octets do.
    """

    __slots__ = ("buffer", "destination", "headroom", "view")

    def __init__(self, buffer: bytearray, headroom: int, destination: str) -> None:
        self.buffer = buffer
        self.headroom = headroom
        self.destination = destination
        self.view = memoryview(buffer)


class Channel(Protocol):
    """One way in and out: a UDP socket, an Ethernet interface, a TCP connection, a loopback."""

    def drain(self, now_ns: int) -> int:
        """Hand every waiting frame to its takers, at most a bounded number; return how many."""

    def send(self, frames: Sequence[OutFrame], now_ns: int) -> Sequence[OutFrame]:
        """Send *frames* at once, never blocking; return those that could not be sent."""

    def link_header(self, destination: str) -> bytes:
        """Return the headroom octets of every frame to *destination*; empty for UDP and TCP."""

    @property
    def minimum_size(self) -> int:
        """Shortest buffer to hand over; shorter frames are padded with zeros."""
