"""The end of a simulated segment on UDP and on Ethernet."""

from __future__ import annotations

import errno
import select
import socket

import pytest

from eap.errors import EnvironmentalError
from eap.ids import InterfaceUri
from eap.net.segmentsocket import SegmentSocket, open_segment

pytestmark = pytest.mark.net

FRAME = bytes.fromhex("0d10 07 00 0000 0000 0100 0000 00 0000")
MASTER = bytes.fromhex("010105010000 00112233445588a4".replace(" ", ""))


def open_udp(text="udp://127.0.9.8"):
    return open_segment(InterfaceUri.parse(text))


def wait(sock):
    assert select.select([sock], [], [], 5)[0]


def test_udp_frame_goes_back_to_its_sender():
    end = open_udp()
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as master:
            master.settimeout(5)
            assert end.receive() is None
            master.sendto(FRAME, ("127.0.9.8", 34980))
            wait(end)
            arrival = end.receive()
            assert arrival.frame == FRAME
            arrival.frame[2] = 8
            end.send(arrival.frame, arrival.origin)
            assert master.recv(100) == FRAME[:2] + b"\x08" + FRAME[3:]
    finally:
        end.close()


def test_sender_that_has_gone_does_no_harm():
    end = open_udp("udp://127.0.9.8:40001")
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as master:
            master.bind(("127.0.0.1", 0))
            origin = master.getsockname()
        for _ in range(3):
            end.send(bytearray(FRAME), origin)
            assert end.receive() is None
    finally:
        end.close()


def test_port_that_is_taken():
    end = open_udp()
    try:
        with pytest.raises(EnvironmentalError, match=r"127\.0\.9\.8"):
            open_udp()
    finally:
        end.close()


def test_pair_whose_other_end_has_gone_does_no_harm():
    near, distant = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    end = SegmentSocket(near)
    try:
        distant.send(FRAME)
        assert end.receive() == (FRAME, b"")
        distant.close()
        end.send(bytearray(FRAME), b"")
        assert end.receive() is None
    finally:
        end.close()


@pytest.mark.parametrize("text", ["tcp://127.0.0.1", "loop://x"])
def test_interface_that_is_no_segments(text):
    with pytest.raises(EnvironmentalError, match="a segment answers on"):
        open_udp(text)


@pytest.mark.root
def test_ethernet_frame_goes_back_marked_and_padded(cable):
    left, right = cable
    end = open_segment(InterfaceUri.parse(f"ethernet://{right}"))
    try:
        with socket.socket(socket.AF_PACKET, socket.SOCK_RAW, socket.htons(0x88A4)) as master:
            master.settimeout(5)
            master.bind((left, 0x88A4))
            master.send(MASTER + FRAME)
            wait(end)
            arrival = end.receive()
            assert arrival.frame[: len(FRAME)] == FRAME
            end.send(arrival.frame, arrival.origin)
            back = master.recv(100)
            assert (back[6], back[14 : 14 + len(FRAME)], len(back)) == (0x02, FRAME, 60)
            assert end.receive() is None  # what goes out does not come in
    finally:
        end.close()


@pytest.mark.root
def test_ethernet_interface_that_is_not_there():
    with pytest.raises(EnvironmentalError, match="nowhere"):
        open_segment(InterfaceUri.parse("ethernet://nowhere"))


def test_segment_socket_survives_errors_of_its_interface():
    class Broken:
        family = socket.AF_INET

        def setblocking(self, flag):
            pass

        def recvfrom(self, size):
            raise OSError(errno.ENETDOWN, "Network is down")

        def sendto(self, *_):
            raise OSError(errno.ENETDOWN, "Network is down")

    sock = SegmentSocket(Broken())
    assert sock.receive() is None
    sock.send(bytearray(60), ("127.0.0.1", 1))
