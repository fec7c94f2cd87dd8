"""UDP driver: one bound socket, received and sent in batches, and its ICMP errors.

The error queue is separate from the queue of datagrams, so another process than the sender may read
it; that takes no privilege.  Asking for errors has two effects.  Each error also makes the next
call on the socket fail, even for another destination: that call has to be made once more.  Sockets
that share an address (SO_REUSEPORT) each get the errors of some destinations, so all must be read.
"""

from __future__ import annotations

import errno
import socket
import struct
from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

from eap.codec.ethercat import EAP_PORT
from eap.compiled import override
from eap.ids import Destination
from eap.net.mmsg import BATCH, ReceiveBatch, SendBatch, note_receive_error
from eap.pd.link import FrameHandler, OutFrame, exchange

_BATCHES_PER_DRAIN = 4
_NO_ADDRESS = "0.0.0.0"  # noqa: S104  a source, which Linux would take for this host


class UdpChannel:
    """Frames in datagrams (ETG.1005: one frame each, UDP port 34980).

    Serves a port's own socket, and those of multicast groups and of broadcasts, from which
    nothing is sent: *handlers* are all stations of the process that listen there.  *batch* may be
    shared by all channels of a process, which are drained one after the other.
    """

    minimum_size = 0

    def __init__(
        self, sock: socket.socket, batch: ReceiveBatch, handlers: Sequence[FrameHandler] = ()
    ) -> None:
        sock.setblocking(False)
        self.handlers = list(handlers)
        self._sock = sock
        self._batch = batch
        self._receive = batch.reader(sock.fileno())
        self._sender = SendBatch(sock, _socket_address)
        self.source_of = batch.source_reader()
        self.errors = self._sender.errors
        self.direct = batch.compiled_socket(sock.fileno(), self.handlers, self, self._sender)
        override(self, "drain", self.direct)

    def drain(self, now_ns: int) -> int:
        """Hand every waiting frame to the handlers, at most 256 in one call."""
        del now_ns  # the kernel's stamps are nearer to the wire
        total = 0
        for _ in range(_BATCHES_PER_DRAIN):
            count = self._receive()
            if count == 1:
                view, size, at_ns = self._batch.arrival()
                for handle in self.handlers:
                    handle(view, size, at_ns, self)
                return total + 1
            if count < 0:
                # An ICMP error of a datagram sent before: received ones still wait.
                if note_receive_error(self.errors):
                    continue
                break
            sizes, times = self._batch.arrivals(count)
            for view, size, at_ns in zip(self._batch.views, sizes, times, strict=False):
                for handle in self.handlers:
                    handle(view, size, at_ns, self)
            total += count
            if count < BATCH:
                break
        return total

    def note_error(self, number: int) -> bool:
        """Count why nothing was received; return whether messages may still be waiting."""
        return note_receive_error(self.errors, number)

    def exchange_handler(self, old: FrameHandler, new: FrameHandler) -> None:
        """Hand to *new* the frames that were handed to *old*, if it is a handler here."""
        exchange(self.handlers, old, new)

    def sender_of(self, data: memoryview) -> str:
        """Return ``address:port`` of the sender of *data*; empty if it has no address."""
        return _destination(self._batch.sender(data))

    def send(self, frames: Sequence[OutFrame], now_ns: int) -> Sequence[OutFrame]:
        """Send *frames* to their destinations; return those that the kernel rejected."""
        del now_ns
        return self._sender.send(frames)

    def link_header(self, destination: str) -> bytes:
        """Return nothing: the kernel writes the headers of a datagram to *destination*."""
        del destination
        return b""

    def fileno(self) -> int:
        """Return the descriptor that becomes readable when a frame waits."""
        return self._sock.fileno()

    def close(self) -> None:
        """Close the socket."""
        self._sock.close()


def _socket_address(destination: str) -> tuple[bytes, tuple[str, int]]:
    """Return the packed ``sockaddr_in`` of *destination* and the form that Python takes."""
    where = Destination.parse(destination)
    address = where.host, where.port or EAP_PORT
    port = struct.pack("!H", address[1])
    return struct.pack("@H", socket.AF_INET) + port + socket.inet_aton(where.host) + bytes(
        8
    ), address


@lru_cache(1024)  # the same ones send again and again
def _destination(sender: tuple[int, bytes]) -> str:
    port, octets = sender
    host = socket.inet_ntoa(octets)
    if host == _NO_ADDRESS:
        return ""
    return f"{host}:{port}" if port else host


IP_RECVERR = 11
ERRORS_PER_CALL = 256

_EXTENDED_ERROR = struct.Struct("@IBBBxII")  # errno, origin, type, code, info, data
_CONTROL_SIZE = 512
_ORIGIN_ICMP = 2
_UNREACHABLE = 3
_TIME_EXCEEDED = 11
_TOO_LARGE = 4


class UdpError(NamedTuple):
    """ICMP error about one datagram."""

    address: str
    """Destination of the datagram, like *port*."""
    port: int
    unreachable: bool
    """True if it did not arrive, for want of a listener or of a route."""
    reason: str
    """The errno's name, such as ECONNREFUSED."""


def enable_errors(sock: socket.socket) -> None:
    """Have the kernel queue the ICMP errors of datagrams that *sock* sends from now on."""
    sock.setsockopt(socket.IPPROTO_IP, IP_RECVERR, 1)


def read_errors(sock: socket.socket, limit: int = ERRORS_PER_CALL) -> list[UdpError]:
    """Take at most *limit* errors from the queue of *sock*, without waiting."""
    found: list[UdpError] = []
    for _ in range(limit):
        try:
            _, control, _, address = sock.recvmsg(
                1, _CONTROL_SIZE, socket.MSG_ERRQUEUE | socket.MSG_DONTWAIT
            )
        except OSError:  # empty: what is pending without an entry says nothing of a destination
            break
        for level, kind, data in control:
            # The address of recvmsg is that of the datagram's destination, not of the host that
            # reports.
            if (level, kind) == (socket.IPPROTO_IP, IP_RECVERR):
                found.append(_parse(data, address))
    return found


def _parse(data: bytes, address: tuple[str, int]) -> UdpError:
    number, origin, kind, code, _, _ = _EXTENDED_ERROR.unpack_from(data)
    return UdpError(
        *address,
        origin == _ORIGIN_ICMP
        and (kind == _TIME_EXCEEDED or (kind == _UNREACHABLE and code != _TOO_LARGE)),
        errno.errorcode.get(number, str(number)),
    )
