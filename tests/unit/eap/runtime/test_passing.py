"""A connection crosses from services to the engine."""

from __future__ import annotations

import socket

import pytest

from eap.runtime.handover import PortName
from eap.runtime.passing import PassedConnection, pass_connection, take_connection

pytestmark = pytest.mark.net

DESCRIPTION = PassedConnection((PortName("a", "eap0"),), "10.0.0.2")


@pytest.fixture
def link():
    services, engine = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with services, engine:
        yield services, engine


def test_descriptor_and_description_arrive_together(link):
    services, engine = link
    assert take_connection(engine) is None
    ours, theirs = socket.socketpair()
    with ours, theirs:
        assert pass_connection(services, theirs, DESCRIPTION)
        theirs.close()
        taken = take_connection(engine)
        assert taken is not None
        connection, description = taken
        assert description == DESCRIPTION
        with connection:
            ours.sendall(b"hello")
            assert connection.recv(5) == b"hello"
    assert take_connection(engine) is None


def test_a_message_without_a_descriptor_is_dropped(link):
    services, engine = link
    services.send(b"{}")
    assert take_connection(engine) is None


def test_a_full_or_closed_link_is_told(link):
    services, engine = link
    with socket.socket() as connection:
        for _ in range(100_000):
            if not pass_connection(services, connection, DESCRIPTION):
                break
        else:
            pytest.fail("the link never filled up")
        while taken := take_connection(engine):
            taken[0].close()
        assert pass_connection(services, connection, DESCRIPTION)
        taken = take_connection(engine)
        assert taken is not None
        taken[0].close()
        engine.close()
        assert not pass_connection(services, connection, DESCRIPTION)
