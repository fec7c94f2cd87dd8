"""A port that sends and takes type 4 over TCP too, beside its datagrams if it has any."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence

from eap.ids import Destination, DestinationKind
from eap.net.limits import CloseReason, ConnectionTable, ListenerLimits
from eap.net.tcp import CONNECTION, TcpReceiver, TcpSender
from eap.pd.link import FrameChannel, FrameHandler, OutFrame, exchange

LIMITS = ListenerLimits(total=32, reserved=8, per_host=16)
"""Incoming connections of a port: each costs a system call a cycle, whether it says anything."""
LOOK_NS = 1_000_000_000
"""Between two looks for connections that leave a frame unfinished."""


class TcpPort:
    """One station's port: *datagrams*, connections to destinations, connections from publishers.

    Args:
        address: Where outgoing connections come from.
        datagrams: The port's UDP channel, if it has one.
        answers: Handlers of the answers that are received on outgoing connections.

    Attributes:
        errors: Frames lost and failed calls of all outgoing connections, by name.
        closed: Incoming connections that ended, by reason.
    """

    minimum_size = 0
    direct = None

    def __init__(
        self,
        address: str,
        datagrams: FrameChannel | None = None,
        answers: Sequence[FrameHandler] = (),
    ) -> None:
        self._answers = list(answers)
        self.errors: dict[str, int] = {}
        self.closed: dict[str, int] = {}
        self._address = address
        self._datagrams = datagrams
        self._senders: dict[str, TcpSender] = {}
        self._receivers: list[TcpReceiver] = []
        self._table = ConnectionTable()
        self._listener = self._table.add_listener("process data", LIMITS)
        self._look_ns = 0

    def link_header(self, destination: str) -> bytes:
        """Return nothing; from now on there is a connection to a TCP *destination*."""
        if destination.startswith(CONNECTION):
            return b""
        is_tcp = Destination.parse(destination).kind is DestinationKind.TCP
        if is_tcp and destination not in self._senders:
            sender = TcpSender(destination, self._address, self.errors, self._answers)
            # Another one, for this may be called while the cycle's thread goes through the old.
            self._senders = {**self._senders, destination: sender}
        return b""

    def follow(self, destinations: Collection[str], answers: Iterable[FrameHandler]) -> None:
        """Keep connections to *destinations* only, and hand received frames to *answers*."""
        # In place: every TcpSender holds this list.
        self._answers[:] = answers
        for gone in self._senders.keys() - destinations:
            self._senders.pop(gone).close()

    @property
    def connections(self) -> int:
        """Number of incoming connections."""
        return len(self._receivers)

    def accept(self, receiver: TcpReceiver, now_ns: int, *, spare_descriptors: int) -> bool:
        """Take frames from *receiver* until its connection ends; return False if it gets no place.

        The policy is that of all listeners (connections.py).
        """
        receiver.used_at_ns = now_ns
        refusal, victim = self._table.admit(
            self._listener, receiver, now_ns, spare_descriptors=spare_descriptors
        )
        if victim is not None:
            victim.close(CloseReason.EVICTED)
        if refusal:
            return False
        self._receivers.append(receiver)
        return True

    def drain(self, now_ns: int) -> int:
        """Hand over received frames, and maintain the outgoing connections."""
        total = self._datagrams.drain(now_ns) if self._datagrams is not None else 0
        for sender in self._senders.values():
            total += sender.poll(now_ns)
        for receiver in self._receivers:
            total += receiver.drain(now_ns)
            if receiver.closed:
                self.closed[receiver.closed] = self.closed.get(receiver.closed, 0) + 1
                self._table.remove(self._listener, receiver)
        if self._receivers:
            self._receivers = [receiver for receiver in self._receivers if not receiver.closed]
            if now_ns >= self._look_ns:
                self._look_ns = now_ns + LOOK_NS
                for late in self._table.remove_overdue(now_ns):
                    late.close(CloseReason.OVERDUE)
        return total

    def exchange_handler(self, old: FrameHandler, new: FrameHandler) -> None:
        """Hand to *new* the frames that were handed to *old*, if it is a handler here."""
        if self._datagrams is not None:
            self._datagrams.exchange_handler(old, new)
        exchange(self._answers, old, new)
        for sender in self._senders.values():
            sender.exchange_handler(old, new)
        for receiver in self._receivers:
            exchange(receiver.handlers, old, new)

    def send(self, frames: Sequence[OutFrame], now_ns: int) -> Sequence[OutFrame]:
        """Send *frames* by the transport of their destinations; return those that were not sent."""
        failed: list[OutFrame] = []
        rest: list[OutFrame] = []
        for frame in frames:
            sender = self._senders.get(frame.destination)
            if sender is not None:
                if not sender.send(frame, now_ns):
                    failed.append(frame)
            elif frame.destination.startswith(CONNECTION):
                if not self._answer(frame):
                    failed.append(frame)
            else:
                rest.append(frame)
        if rest:
            failed += rest if self._datagrams is None else self._datagrams.send(rest, now_ns)
        return failed

    def forget(self, handler: FrameHandler) -> None:
        """Hand no frames to *handler* any more: its port shared the listener and was removed."""
        for receiver in self._receivers:
            if handler in receiver.handlers:
                receiver.handlers.remove(handler)

    def _answer(self, frame: OutFrame) -> bool:
        """Send *frame* back on the connection that it answers."""
        asked = (each for each in self._receivers if each.name == frame.destination)
        receiver = next(asked, None)
        if receiver is not None and receiver.send(frame):
            return True
        reason = "not_connected" if receiver is None or receiver.closed else "slow_peer"
        self.errors[reason] = self.errors.get(reason, 0) + 1
        return False

    def close(self) -> None:
        """Close all connections; the channel of the datagrams is left open."""
        for sender in self._senders.values():
            sender.close()
        for receiver in self._receivers:
            receiver.close()
