"""The sending half of a TCP connection: whole frames, never waiting."""

from __future__ import annotations

import socket

from eap.pd.link import OutFrame

_SEND_BUFFER = 32 << 10
_DEAD_PEER_MS = 3000


class TcpWriter:
    """Sends frames; one that has begun is always finished, and meanwhile others are lost whole.

    Every call raises the OSError that the connection ends with.
    """

    def __init__(self, sock: socket.socket) -> None:
        sock.setblocking(False)
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        # What does not go out soon is stale: neither queue much of it nor retry for minutes.
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER)
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, _DEAD_PEER_MS)
        self._sock = sock
        self._rest = memoryview(b"")

    def flush(self) -> bool:
        """Go on with a frame that has begun; return whether there is none any more."""
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
            self._rest = memoryview(bytes(frame.view[sent:]))
        return True
