"""Interfaces between the cyclic core and the networks: channels to stations, buses of slaves."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol, TypeAlias

from eap.codec.pd import EAP_SM_OFFSET
from eap.pd.words import StationWord


class FrameOrigin(Protocol):
    """Driver that hands a frame to a handler, and knows the sender of the frame."""

    def source_of(self, data: memoryview) -> bytes:
        """Return the address that *data* came from: MAC (6 bytes), IPv4 (4), or none (empty).

        Called for each frame of process data, with *data* as it was handed over.
        """

    def sender_of(self, data: memoryview) -> str:
        """Return the destination by which the port's channel reaches the sender of *data*.

        Only valid while the handler runs.  A reply is an ordinary frame to that destination;
        there can be none when it is empty.
        """


FrameHandler: TypeAlias = Callable[[memoryview, int, int, FrameOrigin], None]
"""Handler of one frame: ``handle(data, size, at_ns, origin)``.

*data* starts at the EtherCAT header and may be longer than the frame; *size* bytes of it arrived.
*at_ns* is the kernel's receive time on the monotonic clock.  The view is valid during the call.
"""


class OutFrame:
    """One frame ready to go: the bytes that a channel puts on its wire, patched in place.

    *buffer* holds *headroom* bytes that belong to the channel (an Ethernet header, or nothing),
    then the EtherCAT frame, then padding.  A channel may cache values derived from the
    object: buffer and destination never change, only the content of the buffer does.

    Attributes:
        oversized: Whether a channel could not send it last because it is too large for its wire.
        signature: Offset of its signature's data behind the headroom; 0 if it is not signed.
    """

    __slots__ = ("buffer", "destination", "headroom", "oversized", "signature", "view")

    def __init__(
        self, buffer: bytearray, headroom: int, destination: str, signature: int = 0
    ) -> None:
        self.buffer = buffer
        self.headroom = headroom
        self.signature = signature
        self.destination = destination
        self.view = memoryview(buffer)
        self.oversized = False


def exchange(handlers: list[FrameHandler], old: FrameHandler, new: FrameHandler) -> None:
    """Put *new* in the place of *old* in a list of handlers."""
    # By identity: frames may be read by an object and its successor, which may be equal.
    handlers[:] = [new if each is old else each for each in handlers]


class FrameChannel(Protocol):
    """Transport of frames: a UDP socket, an Ethernet interface, a TCP connection, a loopback."""

    @property
    def direct(self) -> object:
        """Socket of the compiled part to which frames go as they are; None if there is none."""

    def drain(self, now_ns: int) -> int:
        """Hand every waiting frame to its handlers, at most a bounded number; return how many."""

    def send(self, frames: Sequence[OutFrame], now_ns: int) -> Sequence[OutFrame]:
        """Send *frames* at once, never blocking; return those that could not be sent.

        A destination is what a specification says, or what an origin of the same port gave.
        """

    def exchange_handler(self, old: FrameHandler, new: FrameHandler) -> None:
        """Hand to *new* the frames that were handed to *old*, if it is a handler here."""

    def link_header(self, destination: str) -> bytes:
        """Return the headroom bytes of every frame to *destination*; empty for UDP and TCP."""

    @property
    def minimum_size(self) -> int:
        """Shortest buffer to hand over; shorter frames are padded with zeros."""


class ChannelLayer:
    """Base of what is put before a channel to change or observe the frames that it sends."""

    def __init__(self, channel: FrameChannel) -> None:
        self._channel = channel
        # As attributes, so that a frame pays for no further call.
        self.drain = channel.drain
        self.exchange_handler = channel.exchange_handler
        self.link_header = channel.link_header
        self.minimum_size = channel.minimum_size


class PortTap(Protocol):
    """Observer of the frames of one port; a port without one pays nothing for it."""

    def received(self, handle: FrameHandler) -> FrameHandler:
        """Return a handler that observes a frame and hands it to *handle*."""

    def sending(self, channel: FrameChannel) -> FrameChannel:
        """Return a channel that sends through *channel* and observes what was sent."""


class CyclicBus(Protocol):
    """The slaves of one bus port, as a station's cycle sees them.

    An exchange takes a cycle, and no call waits for it: its frames leave at the end of one cycle,
    with the outputs of that cycle, and what they bring is taken at the start of the next.  No call
    waits or raises: a bus that cannot work counts that and gives the reason in its report, and the
    cycles of all stations continue.
    """

    def copy_inputs(self) -> None:
        """Put what the last exchange brought, inputs and states, into the station's image.

        Called in each cycle, while the engine's region is marked as changing.
        """

    def exchange(self, now_ns: int) -> None:
        """Take the outputs out of the station's image and start the next exchange."""

    def next_timeout(self) -> int | None:
        """Return when :meth:`handle_timeout` has to be called, None for never."""

    def handle_timeout(self, now_ns: int) -> None:
        """Time passed; early calls are harmless."""

    def receive(self, now_ns: int) -> None:
        """Take the frames that are there; called in each cycle before its inputs are taken.

        Also called as soon as frames arrive.  The image stays untouched.
        """


TOGGLE_BIT = 0x20
"""Flips with each frame; bits 0 to 3 are the state, bit 4 is an error, which stops nothing here."""


class StateChannel(ChannelLayer):
    """A channel that writes the EAP SM octet, the state of its device, into all that it sends.

    Off unless a port has ``eap_sm``: older receivers take the byte for a reserved one that is 0.
    Where its bits lie is not public (ETG.1005); they are placed as those of the AL status.  It is
    ignored on receive.

    Args:
        channel: Where the frames go.
        words: Of the station's image, which hold its state.
    """

    direct = None

    def __init__(self, channel: FrameChannel, words: memoryview) -> None:
        super().__init__(channel)
        self._words = words
        self._toggle = 0

    def send(self, frames: Sequence[OutFrame], now_ns: int) -> Sequence[OutFrame]:
        """Send *frames* with state and toggle; return those that could not be sent."""
        # Bits 0 to 3 as in the AL status; their place in the octet is not public (ETG.1005).
        state = self._words[StationWord.STATE] & 0x0F
        for frame in frames:
            # For each frame and not for each call: the bit flips with every new telegram.
            self._toggle ^= TOGGLE_BIT
            frame.view[frame.headroom + EAP_SM_OFFSET] = state | self._toggle
        return self._channel.send(frames, now_ns)
