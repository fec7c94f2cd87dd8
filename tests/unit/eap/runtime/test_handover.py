"""Handover to a child process: everything arrives unchanged."""

from __future__ import annotations

import os
import socket

import pytest

from eap.ids import InterfaceUri, NetId
from eap.pd.spec import CounterSource, PortKind, PortSpec, StationSpec, VariableSpec, Writer
from eap.runtime.handover import (
    EngineOptions,
    Handover,
    PassedConnection,
    PortName,
    SegmentHandover,
    SharedSocket,
    SocketKind,
    pass_connection,
    receive_connection,
)

PORT = PortSpec(
    "eap0", PortKind.EAP, InterfaceUri.parse("udp://127.0.0.1"), NetId.parse("1.2.3.4.5.6")
)
STATION = StationSpec(
    "a",
    NetId.parse("1.1.1.1.1.1"),
    1000,
    (PORT,),
    variables=(VariableSpec("x", "UINT", Writer.ENGINE, default=3),),
    sources=(CounterSource("x"),),
)


def handover() -> Handover:
    shared = SharedSocket(SocketKind.UDP, "127.0.0.1", 34980, owners=(PortName("a", "eap0"),))
    options = EngineOptions(realtime=False, cpu=1)
    return Handover(7, "/run/eap/demo", "demo", "demo.yaml", (STATION,), (shared,), options=options)


def test_crosses_in_a_file_without_a_name():
    fd = handover().to_descriptor()
    assert Handover.from_descriptor(fd) == handover()
    with pytest.raises(OSError, match="Bad file descriptor"):
        os.fstat(fd)


def test_a_segment_gets_its_own():
    given = SegmentHandover(7, "/plants/io.yaml", 5, 6)
    assert SegmentHandover.from_descriptor(given.to_descriptor()) == given


def test_finds_a_port_by_name():
    assert handover().port(PortName("a", "eap0")) == PORT


pytestmark = pytest.mark.net

DESCRIPTION = PassedConnection((PortName("a", "eap0"),), "10.0.0.2")


@pytest.fixture
def link():
    services, engine = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with services, engine:
        yield services, engine


def test_descriptor_and_description_arrive_together(link):
    services, engine = link
    assert receive_connection(engine) is None
    ours, theirs = socket.socketpair()
    with ours, theirs:
        assert pass_connection(services, theirs, DESCRIPTION)
        theirs.close()
        taken = receive_connection(engine)
        assert taken is not None
        connection, description = taken
        assert description == DESCRIPTION
        with connection:
            ours.sendall(b"hello")
            assert connection.recv(5) == b"hello"
    assert receive_connection(engine) is None


def test_a_message_without_a_descriptor_is_dropped(link):
    services, engine = link
    services.send(b"{}")
    assert receive_connection(engine) is None


def test_pass_connection_returns_false_for_full_or_closed_link(link):
    services, engine = link
    with socket.socket() as connection:
        for _ in range(100_000):
            if not pass_connection(services, connection, DESCRIPTION):
                break
        else:
            pytest.fail("the link never filled up")
        while taken := receive_connection(engine):
            taken[0].close()
        assert pass_connection(services, connection, DESCRIPTION)
        taken = receive_connection(engine)
        assert taken is not None
        taken[0].close()
        engine.close()
        assert not pass_connection(services, connection, DESCRIPTION)
