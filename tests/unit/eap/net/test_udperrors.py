from __future__ import annotations

import select
import socket

import pytest

from eap.net.udperrors import UdpError, enable_errors, take_errors

pytestmark = pytest.mark.net


@pytest.fixture
def sender():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(("127.0.0.1", 0))
        enable_errors(sock)
        yield sock


@pytest.fixture
def closed_port():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(("127.0.77.2", 0))
        return sock.getsockname()


def test_nobody_listens(sender, closed_port):
    sender.sendto(b"frame", closed_port)
    select.select([], [], [sender], 1)
    expected = UdpError(*closed_port, True, "ECONNREFUSED")
    assert take_errors(sender) == [expected]
    assert take_errors(sender) == []


def test_taking_the_last_one_clears_what_the_next_call_would_meet(sender, closed_port):
    sender.sendto(b"frame", closed_port)
    take_errors(sender)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as listener:
        listener.bind(("127.0.0.1", 0))
        sender.sendto(b"frame", listener.getsockname())
        assert listener.recv(10) == b"frame"


def test_some_are_left_for_the_next_time(sender, closed_port):
    for _ in range(3):
        sender.sendto(b"frame", closed_port)
        sender.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR)  # or the next would be refused
    assert [len(take_errors(sender, 2)) for _ in range(3)] == [2, 1, 0]


def test_too_large_says_nothing_of_who_is_there(sender):
    sender.setsockopt(socket.IPPROTO_IP, 10, 2)  # IP_MTU_DISCOVER, IP_PMTUDISC_DO
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as listener:
        listener.bind(("127.0.0.1", 0))
        with pytest.raises(OSError, match="too long"):
            sender.sendto(bytes(65507 + 1), listener.getsockname())
        assert all(not error.unreachable for error in take_errors(sender))


def test_nothing_is_queued_unless_asked_for(closed_port):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(("127.0.0.1", 0))
        sock.sendto(b"frame", closed_port)
        assert take_errors(sock) == []
