"""A port that sends and takes type 4 over TCP too, beside its datagrams if it has any."""

from __future__ import annotations

from collections.abc import Sequence

from eap.ids import Destination, DestinationKind
from eap.net.tcp import TcpReceiver, TcpSender
from eap.pd.link import Channel, OutFrame

MOST_CONNECTIONS = 32
"""Incoming connections of a port: each costs a system call a cycle, whether it says anything."""


class TcpPort:
    """One station's port: *datagrams*, connections to destinations, connections from publishers.

    Attributes:
        errors: Frames lost and failed calls of all outgoing connections, by name.
        closed: Incoming connections that ended, by reason.
    """

    minimum_size = 0

    def __init__(self, address: str, datagrams: Channel | None = None) -> None:
        self.errors: dict[str, int] = {}
        self.closed: dict[str, int] = {}
        self._address = address
        self._datagrams = datagrams
        self._senders: dict[str, TcpSender] = {}
        self._receivers: list[TcpReceiver] = []

    def link_header(self, destination: str) -> bytes:
        """Nothing; but from now on there is a connection to a TCP *destination*."""
        is_tcp = Destination.parse(destination).kind is DestinationKind.TCP
        if is_tcp and destination not in self._senders:
            self._senders[destination] = TcpSender(destination, self._address, self.errors)
        return b""

    @property
    def is_full(self) -> bool:
        """Whether there is no room for one more incoming connection."""
        return len(self._receivers) >= MOST_CONNECTIONS

    def accept(self, receiver: TcpReceiver) -> None:
        """Take frames from *receiver* until its connection ends."""
        self._receivers.append(receiver)

    def drain(self, now_ns: int) -> int:
        """Hand over what has arrived, and keep the outgoing connections going."""
        total = self._datagrams.drain(now_ns) if self._datagrams is not None else 0
        for sender in self._senders.values():
            sender.poll(now_ns)
        for receiver in self._receivers:
            total += receiver.drain(now_ns)
            if receiver.closed:
                self.closed[receiver.closed] = self.closed.get(receiver.closed, 0) + 1
        if self._receivers:
            self._receivers = [receiver for receiver in self._receivers if not receiver.closed]
        return total

    def send(self, frames: Sequence[OutFrame], now_ns: int) -> Sequence[OutFrame]:
        """Send *frames* by the way their destinations ask for; return those that were not sent."""
        failed: list[OutFrame] = []
        rest: list[OutFrame] = []
        for frame in frames:
            sender = self._senders.get(frame.destination)
            if sender is None:
                rest.append(frame)
            elif not sender.send(frame, now_ns):
                failed.append(frame)
        if rest:
            failed += rest if self._datagrams is None else self._datagrams.send(rest, now_ns)
        return failed

    def close(self) -> None:
        """Close all connections; the datagrams belong to somebody else."""
        for sender in self._senders.values():
            sender.close()
        for receiver in self._receivers:
            receiver.close()
