"""Type-4 frames over TCP: outgoing connections, incoming connections, and their writer.

The two bytes of the frame header are the only delimiter on the stream.  Nothing here waits: the
cycle drives connecting, sending and receiving, and frames to a slow peer are dropped instead.
Answers to a request come back on the connection that carried the request.
"""

from __future__ import annotations

import errno
import itertools
import socket
from collections.abc import Sequence

from eap.codec.ethercat import EAP_PORT, EtherCatHeader, FrameType
from eap.ids import Destination
from eap.net.limits import OWN_HOST, Activity
from eap.net.mmsg import count_error
from eap.pd.link import FrameHandler, OutFrame, exchange

_SEND_BUFFER = 32 << 10
_DEAD_PEER_MS = 3000


class TcpWriter:
    """Sends frames; one that has begun is always finished, and meanwhile others are lost whole.

    Every call raises the OSError that the connection ends with.
    """

    def __init__(self, sock: socket.socket) -> None:
        sock.setblocking(False)
        # Without it the kernel delays a frame until the one before is confirmed (Nagle).
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        # What does not go out soon is stale: neither queue much of it nor retry for minutes.
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER)
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, _DEAD_PEER_MS)
        self._sock = sock
        self._rest = memoryview(b"")

    def flush(self) -> bool:
        """Continue with a frame that has begun; return whether there is none any more."""
        if self._rest:
            try:
                self._rest = self._rest[self._sock.send(self._rest) :]
            except BlockingIOError:
                return False
        return not self._rest

    def send(self, frame: OutFrame) -> bool:
        """Send *frame* or begin to; return False if the peer is too slow for it."""
        if not self.flush():
            return False
        try:
            sent = self._sock.send(frame.buffer)
        except BlockingIOError:
            return False
        if sent < len(frame.buffer):
            # A copy: the next cycle patches the buffer, and half of each frame would arrive.
            self._rest = memoryview(bytes(frame.view[sent:]))
        return True


FRAMES_PER_DRAIN = 256

_FIRST_BACKOFF_NS = 100_000_000
_LONGEST_BACKOFF_NS = 2_000_000_000
_CONNECT_NS = 1_000_000_000
_RECEIVE_BUFFER = 32 << 10
_CONNECTING = (errno.EINPROGRESS, errno.EALREADY)
_CONNECTED = (0, errno.EISCONN)

CONNECTION = "connection "
"""Prefix of the destinations of answers on accepted connections."""
_numbers = itertools.count(1)


def set_stream_options(sock: socket.socket, unconfirmed_s: float = 60.0) -> None:
    """Set options of a connection for requests and answers.

    Args:
        sock: Of the connection; it does not block any more.
        unconfirmed_s: Time after which it is given up if the peer does not confirm what was sent;
            where nothing is sent it takes a minute.
    """
    sock.setblocking(False)
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, int(1000 * unconfirmed_s))
    set_keepalive(sock, idle_s=30, interval_s=10)


def set_keepalive(sock: socket.socket, *, idle_s: int, interval_s: int) -> None:
    """Have the kernel find out, by three probes, that a peer has vanished without a word."""
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPIDLE, idle_s)
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPINTVL, interval_s)
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPCNT, 3)


class TcpSender:
    """The connection to one destination; it is made again, ever more slowly, while it fails.

    A frame that has begun is always finished.  While that lasts, and while there is no connection,
    frames are lost as a whole and counted in *errors* as ``slow_peer`` and ``not_connected``.
    Received frames go to *handlers*; without any they are dropped.
    """

    def __init__(
        self,
        destination: str,
        source: str,
        errors: dict[str, int],
        handlers: Sequence[FrameHandler] = (),
    ) -> None:
        where = Destination.parse(destination)
        self._destination = destination
        self._address = where.host, where.port or EAP_PORT
        self._source = source
        self._errors = errors
        self._handlers = handlers
        self._sock: socket.socket | None = None
        self._connected = False
        self._writer: TcpWriter | None = None
        self._receiver: TcpReceiver | None = None
        self._backoff_ns = _FIRST_BACKOFF_NS
        self._next_ns = 0
        self._scratch = bytearray(2048)

    @property
    def connected(self) -> bool:
        """True if frames can be sent now."""
        return self._connected

    def poll(self, now_ns: int) -> int:
        """Continue connecting, finish a frame that has begun, notice that the peer has left.

        Returns:
            How many frames came back.
        """
        if self._sock is None:
            if now_ns >= self._next_ns:
                self._connect(now_ns)
            return 0
        if self._writer is None or not self._connected:
            self._continue_connecting(self._sock, now_ns)
            return 0
        try:
            self._writer.flush()
            return self._receive(self._sock, now_ns)
        except OSError as error:
            self._fail(error.errno, now_ns)
            return 0

    def send(self, frame: OutFrame, now_ns: int) -> bool:
        """Send *frame* or begin to; return whether it is on its way."""
        if self._writer is None or not self._connected:
            return self._drop("not_connected")
        try:
            return self._writer.send(frame) or self._drop("slow_peer")
        except OSError as error:
            self._fail(error.errno, now_ns)
            return False

    def exchange_handler(self, old: FrameHandler, new: FrameHandler) -> None:
        """Hand to *new* the frames that were handed to *old*, if it is a handler here."""
        if self._receiver is not None:
            exchange(self._receiver.handlers, old, new)

    def close(self) -> None:
        """Close the connection; :meth:`poll` would open the next one."""
        if self._sock is not None:
            self._sock.close()
        self._sock = None
        self._connected = False
        self._writer = None
        self._receiver = None

    def _drop(self, reason: str) -> bool:
        self._errors[reason] = self._errors.get(reason, 0) + 1
        return False

    def _connect(self, now_ns: int) -> None:
        try:
            sock = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        except OSError as error:
            self._fail(error.errno, now_ns)
            return
        self._sock = sock
        self._next_ns = now_ns + _CONNECT_NS
        try:
            # The address of the port, by which the peer knows this publisher.
            sock.bind((self._source, 0))
            self._writer = TcpWriter(sock)
        except OSError as error:
            self._fail(error.errno, now_ns)
            return
        self._continue_connecting(sock, now_ns)

    def _continue_connecting(self, sock: socket.socket, now_ns: int) -> None:
        # Called again while it connects: EALREADY or EISCONN tells the progress without a poll.
        number = sock.connect_ex(self._address)
        if number in _CONNECTED:
            self._connected = True
            self._listen(sock, now_ns)
        elif number not in _CONNECTING:
            self._fail(number, now_ns)
        elif now_ns >= self._next_ns:
            self._fail(errno.ETIMEDOUT, now_ns)

    def _listen(self, sock: socket.socket, now_ns: int) -> None:
        if not self._handlers:
            return
        try:
            self._receiver = TcpReceiver(sock, self._handlers, self._destination, self._writer)
        except OSError as error:
            self._fail(error.errno, now_ns)

    def _receive(self, sock: socket.socket, now_ns: int) -> int:
        """Receive from the peer; raise OSError if the connection is lost."""
        if self._receiver is None and self._handlers:  # it asks for something since
            self._listen(sock, now_ns)
        if self._receiver is not None:
            count = self._receiver.drain(now_ns)
            if self._receiver.closed:
                self._fail(errno.ECONNRESET, now_ns)
            return count
        try:
            # Read even if nothing is expected: otherwise an end of the peer is noticed only by
            # sending.
            if not sock.recv_into(self._scratch):
                self._fail(errno.ECONNRESET, now_ns)
        except BlockingIOError:
            pass
        return 0

    def _fail(self, number: int | None, now_ns: int) -> None:
        count_error(self._errors, number)
        if self._connected and now_ns - self._next_ns > _LONGEST_BACKOFF_NS:
            self._backoff_ns = _FIRST_BACKOFF_NS  # it had lasted: not a peer that turns us away
        self.close()
        self._next_ns = now_ns + self._backoff_ns
        self._backoff_ns = min(2 * self._backoff_ns, _LONGEST_BACKOFF_NS)


class TcpReceiver:
    """One connection whose frames go to *handlers*, and answers back.

    Args:
        sock: The connection.
        handlers: Handlers of its frames.
        name: The destination of answers to them, if it has been connected to; else it gets one.
        writer: Its writer, if there is one already.
        host: Of the peer, as the policy counts it (connections.py).

    Attributes:
        name: The destination of answers.
        host: As above.
        closed: Reason of the end of the connection, empty while it lasts.
        used_at_ns: Time of the last complete frame; its owner sets the time of its acceptance.
        late_since_ns: Time since which a frame is unfinished.
    """

    def __init__(
        self,
        sock: socket.socket,
        handlers: Sequence[FrameHandler],
        name: str = "",
        writer: TcpWriter | None = None,
        *,
        host: str = OWN_HOST,
    ) -> None:
        self._writer = writer or TcpWriter(sock)
        set_keepalive(sock, idle_s=5, interval_s=2)
        self.handlers = list(handlers)
        self.name = name or f"{CONNECTION}{next(_numbers)}"
        self.host = host
        self.closed = ""
        self.used_at_ns = 0
        self._is_used = False
        self.late_since_ns: int | None = None
        self._sock = sock
        self._source = _peer_of(sock)
        self._buffer = bytearray(_RECEIVE_BUFFER)
        self._view = memoryview(self._buffer)
        self._start = 0
        self._end = 0

    def drain(self, now_ns: int) -> int:
        """Hand every complete frame to the handlers, at most 256; return how many.

        The stream has no time stamps that belong to frames: *now_ns* stands for the arrival.
        """
        if self.closed:
            return 0
        self._write(None)
        # What is left of the last call comes first: the buffer has no room for more before.
        count = self._take_frames(now_ns, FRAMES_PER_DRAIN)
        if count < FRAMES_PER_DRAIN and not self.closed and self._read():
            count += self._take_frames(now_ns, FRAMES_PER_DRAIN - count)
        if count:
            self.used_at_ns = now_ns
            self.late_since_ns = None
            self._is_used = True
        elif self._end > self._start and self.late_since_ns is None:
            self.late_since_ns = now_ns
        return count

    @property
    def activity(self) -> Activity:
        """Current use: frames are expected whenever the publisher has some."""
        return Activity.IDLE if self._is_used else Activity.UNUSED

    def source_of(self, data: memoryview) -> bytes:
        """Return the IPv4 address of the peer."""
        del data  # all that comes from it has one source
        return self._source

    def sender_of(self, data: memoryview) -> str:
        """Return the name of the connection."""
        del data  # all that comes from it has one sender
        return self.name

    def send(self, frame: OutFrame) -> bool:
        """Send an answer or begin to; return whether it is on its way."""
        return not self.closed and self._write(frame)

    def fileno(self) -> int:
        """Return the descriptor that becomes readable when bytes wait, -1 once closed."""
        return self._sock.fileno()

    def close(self, reason: str = "closed here") -> None:
        """Close the connection."""
        self.closed = self.closed or reason
        self._sock.close()

    def _write(self, frame: OutFrame | None) -> bool:
        """Send *frame*, or only continue one that has begun."""
        try:
            return self._writer.flush() if frame is None else self._writer.send(frame)
        except OSError as error:
            self.close(errno.errorcode.get(error.errno or 0, str(error.errno)))
            return False

    def _read(self) -> int:
        rest = self._end - self._start
        self._buffer[:rest] = self._buffer[self._start : self._end]
        self._start, self._end = 0, rest
        try:
            size = self._sock.recv_into(self._view[rest:])
        except BlockingIOError:
            return 0
        except OSError as error:
            self.close(errno.errorcode.get(error.errno or 0, str(error.errno)))
            return 0
        if not size:
            self.close("closed by the peer")
        self._end += size
        return size

    def _take_frames(self, now_ns: int, limit: int) -> int:
        buffer = self._buffer
        for count in range(limit):
            start = self._start
            if self._end - start < EtherCatHeader.SIZE:
                return count
            frame_type = buffer[start + 1] >> 4
            # The length of another type cannot be trusted, so the stream has lost its framing.
            if frame_type != FrameType.PROCESS_DATA:
                self.close(f"frame of type {frame_type}, only type 4 may follow a type 4")
                return count
            size = (buffer[start] | (buffer[start + 1] & 7) << 8) + EtherCatHeader.SIZE
            if self._end - start < size:
                return count
            self._start += size
            for handle in self.handlers:
                handle(self._view[start : start + size], size, now_ns, self)
        return limit


def _peer_of(sock: socket.socket) -> bytes:
    """Return the IPv4 address at the other end; empty if the peer has gone already."""
    try:
        return socket.inet_aton(sock.getpeername()[0])
    except OSError:
        return b""
