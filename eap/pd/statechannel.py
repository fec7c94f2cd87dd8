"""The EAP SM octet: frames that carry the state of the device that sends them (ETG.1005).

Off unless a port is told to: older receivers take the octet for a reserved one that is 0.  Where
its bits lie is not public; they are placed as those of the AL status.  It is ignored on receive.
"""

from __future__ import annotations

from collections.abc import Sequence

from eap.codec.pd import EAP_SM_OFFSET
from eap.pd.link import Channel, OutFrame
from eap.pd.words import StationWord

TOGGLE_BIT = 0x20
"""Flips with each frame; bits 0 to 3 are the state, bit 4 is an error, which stops nothing here."""


class StateChannel:
    """A channel that writes the octet into all that is sent through it.

    Args:
        channel: Where the frames go.
        words: Of the station's image, which hold its state.
    """

    def __init__(self, channel: Channel, words: memoryview) -> None:
        self._channel = channel
        self._words = words
        self._toggle = 0

    @property
    def minimum_size(self) -> int:
        """As that of the channel."""
        return self._channel.minimum_size

    def link_header(self, destination: str) -> bytes:
        """Return what the channel puts in front."""
        return self._channel.link_header(destination)

    def drain(self, now_ns: int) -> int:
        """Drain the channel."""
        return self._channel.drain(now_ns)

    def send(self, frames: Sequence[OutFrame], now_ns: int) -> Sequence[OutFrame]:
        """Send *frames* with state and toggle; return those that could not be sent."""
        state = self._words[StationWord.STATE] & 0x0F
        for frame in frames:
            self._toggle ^= TOGGLE_BIT
            frame.view[frame.headroom + EAP_SM_OFFSET] = state | self._toggle
        return self._channel.send(frames, now_ns)
