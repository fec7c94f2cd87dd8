"""Which MAC address a NetID stands for: told by the frames of the port that has it."""

from __future__ import annotations

from collections.abc import Callable, Container

from eap.codec.ethercat import FrameType
from eap.pd.link import Origin, Taker

LOOK_NS = 100_000_000
"""How often the sender of one NetID's frames is looked at: addresses change rarely."""
_PUBLISHER = slice(2, 8)


class Learner:
    """Looks at the frames of a port on their way to *taker*.

    Attributes:
        sought: The NetIDs whose address is wanted; it may change at any time.
        learn: Called with such a NetID and the address that its frames come from.
    """

    def __init__(self, taker: Taker) -> None:
        self.sought: Container[bytes] = ()
        self.learn: Callable[[bytes, str], None] = forget
        self._taker = taker
        self._looked_at_ns: dict[bytes, int] = {}

    def take(self, data: memoryview, size: int, at_ns: int, origin: Origin) -> None:
        """Note who sent a frame, and hand it over."""
        if self.sought and size >= _PUBLISHER.stop and data[1] >> 4 == FrameType.PROCESS_DATA:
            publisher = bytes(data[_PUBLISHER])
            if publisher in self.sought:
                self._look(publisher, data, at_ns, origin)
        self._taker(data, size, at_ns, origin)

    def _look(self, publisher: bytes, data: memoryview, at_ns: int, origin: Origin) -> None:
        looked_at_ns = self._looked_at_ns.get(publisher)
        if looked_at_ns is None or not 0 <= at_ns - looked_at_ns < LOOK_NS:
            self._looked_at_ns[publisher] = at_ns
            if sender := origin.sender_of(data):
                self.learn(publisher, sender)


def forget(net_id: bytes, sender: str) -> None:
    """Nobody wants to know."""
    del net_id, sender
