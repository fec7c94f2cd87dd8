"""The sending half of a connection: whole frames, and nothing that waits or grows."""

from __future__ import annotations

import contextlib
import socket
import struct
import time

import pytest

from eap.net.tcpwriter import TcpWriter
from eap.pd.link import OutFrame

pytestmark = pytest.mark.net

HERE = "127.0.3.26"


@pytest.fixture
def ends():
    """A writer and the plain socket at the other end, which has little room."""
    with contextlib.ExitStack() as stack:
        server = stack.enter_context(socket.socket())
        server.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        server.bind((HERE, 0))
        server.listen(1)
        sock = stack.enter_context(socket.create_connection(server.getsockname()))
        peer = stack.enter_context(server.accept()[0])
        peer.setblocking(False)
        yield TcpWriter(sock), peer


def frame(number, size=2000):
    return OutFrame(bytearray(struct.pack("<H", 0x4000 | size) + bytes([number]) * size), 0, "")


def read(peer):
    try:
        return peer.recv(65536)
    except BlockingIOError:
        return b""


def test_a_frame_leaves_at_once(ends):
    writer, peer = ends
    assert writer.flush()
    assert writer.send(frame(1, 20))
    assert writer.flush()
    peer.setblocking(True)
    assert peer.recv(100) == bytes(frame(1, 20).buffer)


def test_a_peer_that_does_not_read_costs_no_time_and_no_memory(ends):
    writer, peer = ends
    begin = time.monotonic()
    sent = [number for number in range(2000) if writer.send(frame(number % 250))]
    assert time.monotonic() - begin < 5
    assert len(sent) < 1000
    assert len(writer._rest) < 2002
    # What was begun is whole, and nothing of the others is in between.
    expected = b"".join(bytes(frame(number % 250).buffer) for number in sent)
    got = b""
    limit = time.monotonic() + 5
    while len(got) < len(expected) and time.monotonic() < limit:
        got += read(peer)
        writer.flush()
    assert got == expected
    assert writer.send(frame(1))


def test_what_was_begun_does_not_follow_its_buffer(ends):
    writer, peer = ends
    out = frame(7)
    count = 0
    while writer.send(out) and not writer._rest:
        count += 1
    out.view[2:] = bytes(2000)  # the next cycle patches it
    got = b""
    limit = time.monotonic() + 5
    while len(got) < 2002 * (count + bool(writer._rest)) and time.monotonic() < limit:
        writer.flush()
        got += read(peer)
    assert set(got[2::2002]) == {7}
    assert got.count(0) == 0


def test_a_connection_that_is_lost_raises(ends):
    writer, peer = ends
    peer.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    peer.close()
    with pytest.raises(OSError, match=r"reset|Broken"):
        any(not writer.send(frame(1)) for _ in range(10_000))
