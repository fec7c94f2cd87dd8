"""Ethernet switch of a master: frames between a host and the slaves that have EoE (ETG.1000.6).

The switch learns which port a MAC address is behind and sends a frame there alone; broadcasts,
multicasts and frames to unknown addresses go to all other ports.  Every queue is bounded: a frame
that finds it full is dropped and counted, as switches do.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from typing import NamedTuple

import msgspec

from devicebus.mailbox.conversation import Conversation, MailboxRequest
from devicebus.mailbox.eoe import MAX_FRAME, iter_fragments
from devicebus.mailbox.protocol import MailboxSizes
from eap.codec.eoe import DATA_OVERHEAD
from eap.codec.mailbox import MailboxType

HOST = 0
"""Port of the host; the others are the station addresses of slaves."""
MINIMUM_FRAME = 60
"""Bytes of the shortest Ethernet frame without check sequence; shorter ones are padded."""
MAX_QUEUED = 64
"""Frames that wait at one port."""
MAX_ADDRESSES = 1024
"""Learned MAC addresses; a new one replaces the one that was silent longest."""
AGEING_NS = 300_000_000_000
"""Time after which a silent MAC address is forgotten (IEEE 802.1D)."""
_GROUP = 0x01
_HEADER = 14


class PortCounters(msgspec.Struct, frozen=True, kw_only=True):
    """Frames at one port of a switch."""

    received: int
    """Came in by this port."""
    sent: int
    """Went out by this port."""
    dropped: int
    """Not sent, because too many waited."""
    invalid: int
    """Came in too short or too long, or with fragments missing."""


class _Port:
    __slots__ = ("dropped", "invalid", "queue", "received", "sent")

    def __init__(self) -> None:
        self.queue: deque[bytes] = deque()
        self.received = self.sent = self.dropped = self.invalid = 0


class _LearnedPort(NamedTuple):
    port: int
    until_ns: int


class EthernetSwitch:
    """A learning switch; a port exists as long as it is connected, its counters stay.

    Args:
        notify: Called with each port that has a frame to send.
    """

    def __init__(self, notify: Callable[[int], None]) -> None:
        self._notify = notify
        self._ports: dict[int, _Port] = {}
        self._connected: set[int] = set()
        self._addresses: dict[bytes, _LearnedPort] = {}

    def connect(self, port: int) -> None:
        """Let frames go to a port."""
        self._ports.setdefault(port, _Port())
        self._connected.add(port)

    def disconnect(self, port: int) -> None:
        """Drop what waits at a port, and forget the addresses behind it."""
        self._connected.discard(port)
        if (found := self._ports.get(port)) is not None:
            found.queue.clear()
        for mac in [mac for mac, each in self._addresses.items() if each.port == port]:
            del self._addresses[mac]

    def receive_frame(self, port: int, frame: bytes, now_ns: int) -> None:
        """Send a frame that came in by *port* to where it belongs."""
        source = self._ports.setdefault(port, _Port())
        if not _HEADER <= len(frame) <= MAX_FRAME:
            source.invalid += 1
            return
        source.received += 1
        if not frame[6] & _GROUP:
            self._learn(frame[6:12], port, now_ns)
        for target in self._targets(frame[:6], port, now_ns):
            self._send(target, frame)

    def count_invalid(self, port: int, count: int = 1) -> None:
        """Count frames of a port that could not be assembled."""
        self._ports.setdefault(port, _Port()).invalid += count

    def take_frame(self, port: int) -> bytes | None:
        """Return and remove the next frame for a port, padded to the shortest length."""
        found = self._ports.get(port)
        if found is None or not found.queue:
            return None
        found.sent += 1
        return found.queue.popleft()

    def addresses(self, port: int, now_ns: int) -> list[bytes]:
        """Return the MAC addresses that were learned behind a port."""
        found = self._addresses.items()
        return [mac for mac, each in found if each.port == port and each.until_ns > now_ns]

    def counters(self, port: int) -> PortCounters:
        """Return the counters of a port."""
        found = self._ports.get(port) or _Port()
        return PortCounters(
            received=found.received, sent=found.sent, dropped=found.dropped, invalid=found.invalid
        )

    def _learn(self, mac: bytes, port: int, now_ns: int) -> None:
        # Behind the others again, so that the first one was silent longest.
        self._addresses.pop(mac, None)
        self._addresses[mac] = _LearnedPort(port, now_ns + AGEING_NS)
        if len(self._addresses) > MAX_ADDRESSES:
            del self._addresses[next(iter(self._addresses))]

    def _targets(self, mac: bytes, source: int, now_ns: int) -> Iterator[int]:
        known = None if mac[0] & _GROUP else self._addresses.get(mac)
        if known is not None and known.until_ns > now_ns:
            if known.port != source:
                yield known.port
            return
        yield from (port for port in sorted(self._connected) if port != source)

    def _send(self, port: int, frame: bytes) -> None:
        target = self._ports[port]
        if port not in self._connected or len(target.queue) >= MAX_QUEUED:
            target.dropped += 1
            return
        target.queue.append(frame.ljust(MINIMUM_FRAME, b"\0"))
        self._notify(port)


def send_frame(frame: bytes, number: int, sizes: MailboxSizes) -> Conversation[None]:
    """Send an Ethernet frame to a slave; nothing answers it.

    Args:
        frame: Without check sequence.
        number: Frame number from 0 to 15, incremented for each frame.
        sizes: Of the slave's mailboxes.

    Raises:
        CodecError: the frame is too long, or the mailbox too small.
    """
    for fragment in iter_fragments(frame, number, sizes.to_slave - DATA_OVERHEAD):
        yield MailboxRequest(MailboxType.EOE, fragment, expects_reply=False)
