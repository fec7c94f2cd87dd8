"""What bus ports need is opened once, and segments get their side of it."""

from __future__ import annotations

import socket
from contextlib import ExitStack

import pytest

from eap.errors import EnvironmentalError
from eap.pd.spec import BusPortSpec, PortKind, PortSpec, StationSpec
from eap.runtime.handover import NO_DESCRIPTOR, PortName
from eap.supervisor.bus_sockets import bus_ports, open_buses, open_message_pair, segments
from tests.unit.eap.conftest import eap_port

SIM = BusPortSpec("/plants/io.yaml")


def bus_port(name, interface, bus=SIM):
    return PortSpec(name, PortKind.BUS, interface, "1.1.1.1.9.1", bus=bus)


def stations(*ports):
    first = StationSpec("a", "1.1.1.1.1.1", 1000, (eap_port(1), *ports))
    second = StationSpec("b", "1.1.1.1.1.2", 1000, (bus_port("bus0", "sim:///plants/io.yaml"),))
    return first, second


def test_ports_are_numbered_station_by_station():
    plant = stations(bus_port("bus0", "udp://127.0.9.1"), bus_port("bus1", "udp://127.0.9.2"))
    assert [name for name, _ in bus_ports(plant)] == [
        PortName("a", "bus0"),
        PortName("a", "bus1"),
        PortName("b", "bus0"),
    ]


@pytest.mark.net
def test_simulated_buses_have_two_pairs_and_others_one_socket():
    plant = stations(bus_port("bus0", "udp://127.0.9.1:40009"))
    with ExitStack() as opened:
        remote, simulated = open_buses(plant, opened)
        assert remote.owner == PortName("a", "bus0")
        assert remote.segment_fd == remote.segment_command_fd == remote.command_fd == NO_DESCRIPTOR
        with socket.socket(fileno=socket.dup(remote.engine_fd)) as sock:
            assert sock.getpeername() == ("127.0.9.1", 40009)
        for one, other in (
            (simulated.engine_fd, simulated.segment_fd),
            (simulated.command_fd, simulated.segment_command_fd),
        ):
            with (
                socket.socket(fileno=socket.dup(one)) as near,
                socket.socket(fileno=socket.dup(other)) as far,
            ):
                near.send(b"one")
                near.send(b"two")
                assert (far.recv(100), far.recv(100)) == (b"one", b"two")
        ((name, handover),) = segments(plant, (remote, simulated), 77, realtime=True)
        assert name == PortName("b", "bus0")
        assert (handover.supervisor, handover.file) == (77, "/plants/io.yaml")
        assert handover.frames_fd == simulated.segment_fd
        assert handover.command_fd == simulated.segment_command_fd
        assert handover.realtime


@pytest.mark.net
def test_an_interface_that_is_not_there_is_named():
    plant = stations(bus_port("bus0", "ethernet://nothere"))
    with ExitStack() as opened, pytest.raises(EnvironmentalError, match="'nothere'"):
        open_buses(plant, opened)


@pytest.mark.net
def test_a_pair_is_closed_with_the_rest():
    with ExitStack() as opened:
        one, other = open_message_pair(opened)
        assert one != other
    with pytest.raises(OSError, match="Bad file descriptor"):
        socket.dup(one)
