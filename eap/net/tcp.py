"""Type-4 frames over TCP: one connection out, one connection in, and the listener.

The two octets of the frame header are the only delimiter on the stream.  Nothing here waits: the
cycle drives connecting, sending and receiving, and a peer that is slow loses frames instead.
"""

from __future__ import annotations

import errno
import socket
from collections.abc import Sequence

from eap.codec.ethercat import EAP_PORT, EtherCatHeader, FrameType
from eap.errors import EnvironmentalError
from eap.ids import Destination
from eap.net.mmsg import count_error
from eap.net.udpsocket import bind_failure
from eap.pd.link import OutFrame, Taker

FRAMES_PER_DRAIN = 256

_FIRST_BACKOFF_NS = 100_000_000
_LONGEST_BACKOFF_NS = 2_000_000_000
_CONNECT_NS = 1_000_000_000
_DEAD_PEER_MS = 3000
_SEND_BUFFER = 32 << 10
_RECEIVE_BUFFER = 32 << 10
_BACKLOG = 64
_CONNECTING = (errno.EINPROGRESS, errno.EALREADY)
_CONNECTED = (0, errno.EISCONN)


def open_tcp_listener(address: str, port: int = EAP_PORT) -> socket.socket:
    """Return a socket that listens on *address*.

    Raises:
        EnvironmentalError: the port is taken, and by whom, or the address is not this machine's.
    """
    sock = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    try:
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        sock.bind((address, port))
        sock.listen(_BACKLOG)
    except OSError as error:
        sock.close()
        raise EnvironmentalError(bind_failure("TCP", address, port, error)) from None
    return sock


class TcpSender:
    """The connection to one destination; it is made again, ever more slowly, while it fails.

    A frame that has begun is always finished.  While that lasts, and while there is no connection,
    frames are lost as a whole and counted in *errors* as ``slow_peer`` and ``not_connected``.
    """

    def __init__(self, destination: str, source: str, errors: dict[str, int]) -> None:
        where = Destination.parse(destination)
        self._address = where.host, where.port or EAP_PORT
        self._source = source
        self._errors = errors
        self._sock: socket.socket | None = None
        self._connected = False
        self._rest = memoryview(b"")
        self._backoff_ns = _FIRST_BACKOFF_NS
        self._next_ns = 0
        self._scratch = bytearray(2048)

    @property
    def connected(self) -> bool:
        """Whether frames can be sent now."""
        return self._connected

    def poll(self, now_ns: int) -> None:
        """Go on connecting, finish a frame that has begun, notice that the peer has left."""
        if self._sock is None:
            if now_ns >= self._next_ns:
                self._connect(now_ns)
        elif not self._connected:
            self._go_on_connecting(self._sock, now_ns)
        elif self._peer_is_there(self._sock, now_ns) and self._rest:
            self._flush(self._sock, now_ns)

    def send(self, frame: OutFrame, now_ns: int) -> bool:
        """Send *frame* or begin to; return whether it is on its way."""
        sock = self._sock
        if sock is None or not self._connected:
            return self._lose("not_connected")
        if self._rest:
            self._flush(sock, now_ns)
            if self._rest or not self._connected:
                return self._lose("slow_peer" if self._connected else "not_connected")
        try:
            sent = sock.send(frame.buffer)
        except BlockingIOError:
            return self._lose("slow_peer")
        except OSError as error:
            self._fail(error.errno, now_ns)
            return False
        if sent < len(frame.buffer):
            self._rest = memoryview(bytes(frame.view[sent:]))
        return True

    def close(self) -> None:
        """Close the connection; :meth:`poll` would open the next one."""
        if self._sock is not None:
            self._sock.close()
        self._sock = None
        self._connected = False
        self._rest = memoryview(b"")

    def _lose(self, reason: str) -> bool:
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
            sock.setblocking(False)
            sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            # What does not go out soon is stale: neither queue much of it nor retry for minutes.
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER)
            sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, _DEAD_PEER_MS)
            sock.bind((self._source, 0))
        except OSError as error:
            self._fail(error.errno, now_ns)
            return
        self._go_on_connecting(sock, now_ns)

    def _go_on_connecting(self, sock: socket.socket, now_ns: int) -> None:
        number = sock.connect_ex(self._address)
        if number in _CONNECTED:
            self._connected = True
        elif number not in _CONNECTING:
            self._fail(number, now_ns)
        elif now_ns >= self._next_ns:
            self._fail(errno.ETIMEDOUT, now_ns)

    def _peer_is_there(self, sock: socket.socket, now_ns: int) -> bool:
        """Throw away what the peer says: only a publisher speaks on its connection."""
        try:
            if sock.recv_into(self._scratch):
                return True
            self._fail(errno.ECONNRESET, now_ns)
        except BlockingIOError:
            return True
        except OSError as error:
            self._fail(error.errno, now_ns)
        return False

    def _flush(self, sock: socket.socket, now_ns: int) -> None:
        try:
            self._rest = self._rest[sock.send(self._rest) :]
        except BlockingIOError:
            return
        except OSError as error:
            self._fail(error.errno, now_ns)

    def _fail(self, number: int | None, now_ns: int) -> None:
        count_error(self._errors, number)
        if self._connected and now_ns - self._next_ns > _LONGEST_BACKOFF_NS:
            self._backoff_ns = _FIRST_BACKOFF_NS  # it had lasted: not a peer that turns us away
        self.close()
        self._next_ns = now_ns + self._backoff_ns
        self._backoff_ns = min(2 * self._backoff_ns, _LONGEST_BACKOFF_NS)


class TcpReceiver:
    """One accepted connection; its frames go to *takers*.

    Attributes:
        closed: Why the connection ended, empty while it lasts.
    """

    def __init__(self, sock: socket.socket, takers: Sequence[Taker]) -> None:
        sock.setblocking(False)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPIDLE, 5)
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPINTVL, 2)
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPCNT, 3)
        self.takers = list(takers)
        self.closed = ""
        self._sock = sock
        self._buffer = bytearray(_RECEIVE_BUFFER)
        self._view = memoryview(self._buffer)
        self._start = 0
        self._end = 0

    def drain(self, now_ns: int) -> int:
        """Hand every complete frame to the takers, at most 256; return how many.

        The stream has no time stamps that belong to frames: *now_ns* stands for the arrival.
        """
        if self.closed:
            return 0
        count = self._take_frames(now_ns, FRAMES_PER_DRAIN)
        if count < FRAMES_PER_DRAIN and not self.closed and self._read():
            count += self._take_frames(now_ns, FRAMES_PER_DRAIN - count)
        return count

    def fileno(self) -> int:
        """Return the descriptor that becomes readable when octets wait, -1 once closed."""
        return self._sock.fileno()

    def close(self, reason: str = "closed here") -> None:
        """Close the connection."""
        self.closed = self.closed or reason
        self._sock.close()

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
            if frame_type != FrameType.PROCESS_DATA:
                self.close(f"frame of type {frame_type}, only type 4 may follow a type 4")
                return count
            size = (buffer[start] | (buffer[start + 1] & 7) << 8) + EtherCatHeader.SIZE
            if self._end - start < size:
                return count
            self._start += size
            for take in self.takers:
                take(self._view[start : start + size], size, now_ns)
        return limit
