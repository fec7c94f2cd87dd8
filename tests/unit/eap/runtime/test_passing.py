"""Descriptors passed between processes: they arrive with their messages, and nothing waits."""

from __future__ import annotations

import os
import socket

import pytest

from eap.runtime.handover import PortName, SharedSocket, SocketKind
from eap.runtime.passing import (
    CloseSocket,
    OpenSocket,
    PassedConnection,
    PassedSocket,
    SupervisorRequests,
    close_descriptors,
    pass_connection,
    pass_descriptors,
    pass_socket,
    receive_passed,
    receive_reply,
)

pytestmark = pytest.mark.net

DESCRIPTION = PassedConnection((PortName("a", "eap0"),), "10.0.0.2")


@pytest.fixture
def link():
    services, engine = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with services, engine:
        yield services, engine


def test_descriptor_and_description_arrive_together(link):
    services, engine = link
    assert receive_passed(engine) is None
    ours, theirs = socket.socketpair()
    with ours, theirs:
        assert pass_connection(services, theirs, DESCRIPTION)
        theirs.close()
        taken = receive_passed(engine)
        assert taken is not None
        connection, description = taken
        assert description == DESCRIPTION
        with connection:
            ours.sendall(b"hello")
            assert connection.recv(5) == b"hello"
    assert receive_passed(engine) is None


def test_a_message_without_a_descriptor_is_dropped(link):
    services, engine = link
    services.send(b"{}")
    assert receive_passed(engine) is None


def test_pass_connection_returns_false_for_full_or_closed_link(link):
    services, engine = link
    with socket.socket() as connection:
        for _ in range(100_000):
            if not pass_connection(services, connection, DESCRIPTION):
                break
        else:
            pytest.fail("the link never filled up")
        while taken := receive_passed(engine):
            taken[0].close()
        assert pass_connection(services, connection, DESCRIPTION)
        taken = receive_passed(engine)
        assert taken is not None
        taken[0].close()
        engine.close()
        assert not pass_connection(services, connection, DESCRIPTION)


SHARED = SharedSocket(SocketKind.UDP, "127.0.0.1", 34980)


def test_socket_of_the_engine_arrives_with_its_key(link):
    services, engine = link
    owned = SharedSocket(SocketKind.UDP, "127.0.0.1", 34980, owners=(PortName("a", "eap0"),))
    with socket.socket() as sock:
        assert pass_socket(services, owned, sock)
        taken = receive_passed(engine)
        assert taken is not None
        copy, message = taken
        with copy:
            assert message == PassedSocket(SHARED)
            assert os.path.sameopenfile(copy.fileno(), sock.fileno())


def test_supervisor_requests_are_answered_with_named_descriptors(link):
    services, end = link
    requests = SupervisorRequests(end)
    assert requests.receive() is None
    pass_descriptors(services, OpenSocket(7, SHARED), [])
    pass_descriptors(services, CloseSocket(SHARED), [])
    assert requests.receive() == OpenSocket(7, SHARED)
    assert requests.receive() == CloseSocket(SHARED)
    with socket.socket() as one, socket.socket() as two:
        requests.reply(7, {"engine_fd": one.fileno(), "services_fd": two.fileno()})
        received = receive_reply(services)
        assert received is not None
        reply, descriptors = received
        assert (reply.id, reply.error, list(descriptors)) == (7, "", ["engine_fd", "services_fd"])
        assert os.path.sameopenfile(descriptors["services_fd"], two.fileno())
        close_descriptors(descriptors)
    requests.refuse(8, "in use")
    received = receive_reply(services)
    assert received is not None
    assert (received[0].id, received[0].error, received[1]) == (8, "in use", {})
    services.close()
    assert requests.receive() is None
