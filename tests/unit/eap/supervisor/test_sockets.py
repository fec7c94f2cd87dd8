"""The plan of shared sockets, and that all of them open or none."""

from __future__ import annotations

import gc
import os
import socket
from contextlib import ExitStack, closing
from pathlib import Path

import msgspec
import pytest

from eap.errors import EnvironmentalError
from eap.ids import InterfaceUri, NetId
from eap.pd.spec import BusPortSpec, GatewaySpec, PortKind, PortSpec, StationSpec
from eap.runtime.handover import (
    NO_DESCRIPTOR,
    BusSocket,
    Handover,
    PortName,
    SharedSocket,
    SocketKind,
)
from eap.runtime.passing import (
    CloseSocket,
    KeepBuses,
    OpenBus,
    OpenSocket,
    pass_descriptors,
    receive_reply,
)
from eap.runtime.socket_plan import plan_buses, plan_sockets
from eap.supervisor.sockets import (
    SharedSockets,
    UnavailableSocketError,
    inherited_by_engine,
    inherited_by_services,
    open_message_pair,
)
from tests.unit.eap.conftest import eap_port, left, right

LEFT, RIGHT = PortName("left", "eap0"), PortName("right", "eap0")


def test_a_udp_port_needs_a_pair_and_a_listener():
    planned = plan_sockets([left(), right()])
    assert [(s.kind, s.address, s.port, s.owners) for s in planned] == [
        (SocketKind.UDP, "127.9.2.1", 34980, (LEFT,)),
        (SocketKind.UDP, "127.9.2.2", 34980, (RIGHT,)),
        (SocketKind.TCP, "127.9.2.1", 34980, (LEFT,)),
        (SocketKind.TCP, "127.9.2.2", 34980, (RIGHT,)),
        (SocketKind.AMS_TCP, "127.9.2.1", 0, (LEFT,)),
        (SocketKind.AMS_TCP, "127.9.2.2", 0, (RIGHT,)),
        (SocketKind.AMS_UDP, "127.9.2.1", 0, (LEFT,)),
        (SocketKind.AMS_UDP, "127.9.2.2", 0, (RIGHT,)),
        (SocketKind.AMS_BROADCAST, "127.9.2.1", 0, (LEFT,)),
        (SocketKind.AMS_BROADCAST, "127.9.2.1", 0, (LEFT,)),
        (SocketKind.AMS_BROADCAST, "127.9.2.2", 0, (RIGHT,)),
        (SocketKind.AMS_BROADCAST, "127.9.2.2", 0, (RIGHT,)),
    ]


def ams_of(*stations: StationSpec) -> list[tuple[str, str, tuple[PortName, ...]]]:
    kinds = (SocketKind.AMS_TCP, SocketKind.AMS_UDP)
    return [(s.kind, s.address, s.owners) for s in plan_sockets(stations) if s.kind in kinds]


def test_stations_of_one_address_share_ams_sockets():
    lodger = right(eap_port(2, "tcp://127.9.2.1:5000"))
    assert ams_of(left(), lodger) == [
        (SocketKind.AMS_TCP, "127.9.2.1", (LEFT, RIGHT)),
        (SocketKind.AMS_UDP, "127.9.2.1", (LEFT, RIGHT)),
    ]
    assert ams_of(left(eap_port(1, ams=False)), lodger) == [
        (SocketKind.AMS_TCP, "127.9.2.1", (RIGHT,)),
        (SocketKind.AMS_UDP, "127.9.2.1", (RIGHT,)),
    ]


def test_wildcard_address_shares_ams_sockets_with_all():
    everywhere = right(eap_port(2, "udp://0.0.0.0:5000"))
    assert ams_of(left(), everywhere) == [
        (SocketKind.AMS_TCP, "0.0.0.0", (LEFT, RIGHT)),
        (SocketKind.AMS_UDP, "0.0.0.0", (LEFT, RIGHT)),
    ]


def test_no_ams_without_an_ip_address():
    without = (eap_port(1, ams=False), eap_port(1, "loop://line"), eap_port(1, "ethernet://eth0"))
    assert [ams_of(left(port)) for port in without] == [[], [], []]


def test_gateways_have_their_own_at_each_address():
    def bus(number: int, own: int) -> PortSpec:
        return PortSpec(
            f"bus{number}", PortKind.BUS, InterfaceUri.parse("sim://bus.yaml"),
            NetId.parse(f"5.1.1.1.{number}.1"), bus=BusPortSpec(), gateway=GatewaySpec(port=own),
        )  # fmt: skip

    station = msgspec.structs.replace(left(), ports=(eap_port(1), bus(0, 0), bus(1, 34981)))
    kinds = (SocketKind.GATEWAY_UDP, SocketKind.GATEWAY_TCP)
    owners = (PortName("left", "bus1"),)
    assert [
        (s.kind, s.address, s.port, s.owners) for s in plan_sockets([station]) if s.kind in kinds
    ] == [(kind, "127.9.2.1", 34981, owners) for kind in kinds]


def test_groups_and_broadcasts_have_their_own():
    port = eap_port(1, "udp://127.9.2.1:5000", join=("239.1.1.1", "239.1.1.2"), broadcast=True)
    planned = plan_sockets([left(port)])
    assert [(s.kind, s.group, s.port) for s in planned] == [
        (SocketKind.UDP, "", 5000),
        (SocketKind.GROUP, "239.1.1.1", 5000),
        (SocketKind.GROUP, "239.1.1.2", 5000),
        (SocketKind.GROUP, "255.255.255.255", 5000),
        (SocketKind.TCP, "", 5000),
        (SocketKind.AMS_TCP, "", 0),
        (SocketKind.AMS_UDP, "", 0),
        (SocketKind.AMS_BROADCAST, "", 0),
        (SocketKind.AMS_BROADCAST, "255.255.255.255", 0),
    ]


def test_stations_share_an_ethernet_interface():
    planned = plan_sockets(
        [left(eap_port(1, "ethernet://eth0", vlan_id=5)), right(eap_port(2, "ethernet://eth0"))]
    )
    assert [(s.kind, s.address, s.owners) for s in planned] == [
        (SocketKind.PACKET, "eth0", (LEFT, RIGHT)),
        (SocketKind.ARP, "eth0", (LEFT,)),
        (SocketKind.ARP, "eth0", (RIGHT,)),
    ]
    assert [s.vlan_id for s in planned] == [0, 5, 0]


def test_loopback_ports_need_no_sockets():
    assert plan_sockets([left(eap_port(1, "loop://line"))]) == ()
    tcp_only = plan_sockets([left(eap_port(1, "tcp://127.9.2.1", ams=False))])
    assert [s.kind for s in tcp_only] == [SocketKind.TCP]


def open_descriptors() -> int:
    gc.collect()  # what an earlier test left to the collector must not go while we count
    return len(list(Path("/proc/self/fd").iterdir()))


def handover(shared: SharedSockets, *stations: StationSpec) -> Handover:
    return Handover(
        1, "", "", "", stations, shared.fit(stations), link_fd=shared.services_link,
        control_fd=shared.control, buses=shared.buses, bus_fd=shared.services_bus,
        supervisor_fd=shared.services_end,
    )  # fmt: skip


@pytest.mark.net
def test_all_are_opened_and_described(tmp_path):
    before = open_descriptors()
    port = eap_port(1, join=("239.1.1.1",), broadcast=True)
    with SharedSockets(tmp_path / "control") as shared:
        given = handover(shared, left(port))
        for described in given.sockets:
            of_both = described.kind in {SocketKind.UDP, SocketKind.GROUP}
            assert (described.engine_fd != NO_DESCRIPTOR) == of_both
            assert described.services_fd != NO_DESCRIPTOR
        inherited = inherited_by_services(given)
        assert len(set(inherited)) == len(inherited)
        assert not any(os.get_inheritable(fd) for fd in inherited)
        engine = {each.engine_fd for each in given.sockets} - {NO_DESCRIPTOR}
        assert engine < set(inherited_by_engine(given))
        with socket.socket(socket.AF_UNIX) as client:
            client.connect(str(tmp_path / "control"))
    assert open_descriptors() == before


@pytest.mark.net
def test_buses_add_theirs(tmp_path):
    before = open_descriptors()
    bus = PortSpec(
        "bus0",
        PortKind.BUS,
        InterfaceUri.parse("sim:///x.yaml"),
        NetId.parse("1.1.1.1.1.9"),
        bus=BusPortSpec("/x.yaml"),
    )
    station = left()
    station = msgspec.structs.replace(station, ports=(*station.ports, bus))
    with SharedSockets(tmp_path / "control") as shared:
        (described,) = shared.fit_buses([station])
        given = handover(shared, station)
        assert described.engine_fd in inherited_by_engine(given)
        assert {described.command_fd, shared.services_bus} < set(inherited_by_services(given))
        segment = {described.segment_fd, described.segment_command_fd}
        assert not segment & {*inherited_by_engine(given), *inherited_by_services(given)}
    assert open_descriptors() == before


@pytest.mark.net
def test_shared_sockets_close_all_when_one_fails(tmp_path):
    before = open_descriptors()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as squatter:
        squatter.bind(("127.9.2.2", 34980))
        with (
            SharedSockets(tmp_path / "control") as shared,
            pytest.raises(UnavailableSocketError, match=r"127\.9\.2\.2:34980") as caught,
        ):
            shared.fit([left(), right()])
    assert caught.value.owners == (RIGHT,)
    assert open_descriptors() == before
    (tmp_path / "control2").touch()
    with pytest.raises(EnvironmentalError, match="control socket"):
        SharedSockets(tmp_path / "control2")
    assert open_descriptors() == before


@pytest.mark.net
def test_sockets_of_ports_that_stay_are_not_opened_again(tmp_path):
    with SharedSockets(tmp_path / "control") as shared:
        first = shared.fit([left()])
        both = shared.fit([left(), right()])
        assert {each.services_fd for each in first} < {each.services_fd for each in both}
        shared.keep_only(first)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
            free.bind(("127.9.2.2", 34980))
        assert shared.fit([left()]) == first


@pytest.mark.net
def test_services_requests_sockets(tmp_path):
    wanted = SharedSocket(SocketKind.UDP, "127.9.2.1", 34980)
    with (
        SharedSockets(tmp_path / "control") as shared,
        socket.socket(fileno=os.dup(shared.services_end)) as services,
    ):

        def request(number: int, socket: SharedSocket) -> tuple[str, set[str]]:
            pass_descriptors(services, OpenSocket(number, socket), [])
            shared.serve()
            received = receive_reply(services)
            assert received is not None
            for fd in received[1].values():
                os.close(fd)
            assert received[0].id == number
            return received[0].error, set(received[1])

        pair = ("", {"engine_fd", "services_fd"})
        assert request(1, wanted) == pair
        assert request(2, wanted) == pair
        broken = SharedSocket(SocketKind.PACKET, "nothere")
        error, descriptors = request(3, broken)
        assert "nothere" in error
        assert not descriptors
        pass_descriptors(services, CloseSocket(wanted), [])
        pass_descriptors(services, CloseSocket(broken), [])
        shared.serve()
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
            free.bind(("127.9.2.1", 34980))


SIM = BusPortSpec("/plants/io.yaml")


def bus_port(name, interface, bus=SIM):
    return PortSpec(
        name, PortKind.BUS, InterfaceUri.parse(interface), NetId.parse("1.1.1.1.9.1"), bus=bus
    )


def stations(*ports):
    first = StationSpec("a", NetId.parse("1.1.1.1.1.1"), 1000, (eap_port(1), *ports))
    second = StationSpec(
        "b", NetId.parse("1.1.1.1.1.2"), 1000, (bus_port("bus0", "sim:///plants/io.yaml"),)
    )
    return first, second


def test_buses_are_planned_station_by_station():
    ring = msgspec.structs.replace(SIM, redundant="udp://127.0.9.2", simulated="digest")
    plant = stations(bus_port("bus0", "udp://127.0.9.1"), bus_port("bus1", "udp://127.0.9.2", ring))
    assert plan_buses(plant) == (
        BusSocket(PortName("a", "bus0"), interface="udp://127.0.9.1"),
        BusSocket(
            PortName("a", "bus1"),
            interface="udp://127.0.9.2",
            redundant="udp://127.0.9.2",
            simulated="digest",
        ),
        BusSocket(PortName("b", "bus0"), interface="sim:///plants/io.yaml"),
    )


@pytest.mark.net
def test_simulated_buses_have_two_pairs_and_others_one_socket(tmp_path):
    plant = stations(bus_port("bus0", "udp://127.0.9.1:40009"))
    with SharedSockets(tmp_path / "control") as shared:
        remote, simulated = shared.fit_buses(plant)
        assert shared.buses == (remote, simulated)
        assert remote.owner == PortName("a", "bus0")
        assert 0 < remote.number < simulated.number
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


@pytest.mark.net
def test_bus_with_other_lines_has_another_number(tmp_path):
    before = open_descriptors()
    ring = msgspec.structs.replace(SIM, redundant="sim:///plants/io.yaml")
    changed = msgspec.structs.replace(SIM, simulated="other slaves")
    with SharedSockets(tmp_path / "control") as shared:
        (first,) = shared.fit_buses([stations()[1]])
        assert shared.fit_buses([stations()[1]]) == (first,)
        numbers = {first.number}
        for bus in (ring, changed):
            port = bus_port("bus0", "sim:///plants/io.yaml", bus)
            (other,) = shared.fit_buses([msgspec.structs.replace(stations()[1], ports=(port,))])
            numbers.add(other.number)
            assert (other.second_fd != NO_DESCRIPTOR) == (bus is ring)
        shared.keep_only(())
        assert shared.buses == ()
        (again,) = shared.fit_buses([stations()[1]])
        assert len({*numbers, again.number}) == 4
    assert open_descriptors() == before


@pytest.mark.net
def test_an_interface_that_is_not_there_is_named(tmp_path):
    plant = stations(bus_port("bus0", "ethernet://nothere"))
    with (
        SharedSockets(tmp_path / "control") as shared,
        pytest.raises(UnavailableSocketError, match="'nothere'") as caught,
    ):
        shared.fit_buses(plant)
    assert caught.value.owners == (PortName("a", "bus0"),)


class Requester:
    """Services' end of the pair with the supervisor."""

    def __init__(self, shared):
        self._shared = shared
        self._socket = socket.socket(fileno=os.dup(shared.services_end))

    def send(self, message):
        pass_descriptors(self._socket, message, [])
        self._shared.serve()

    def reply(self):
        """Return error, names of descriptors, and number of a bus; None without a reply."""
        received = receive_reply(self._socket)
        if received is None:
            return None
        for fd in received[1].values():
            os.close(fd)
        return received[0].error, set(received[1]), received[0].number

    def close(self):
        self._socket.close()


@pytest.mark.net
def test_services_requests_buses(tmp_path):
    remote, simulated = (
        each.key for each in plan_buses(stations(bus_port("b", "udp://127.0.9.1")))
    )
    with SharedSockets(tmp_path / "control") as shared, closing(Requester(shared)) as services:
        services.send(OpenBus(1, remote))
        assert services.reply() == ("", {"engine_fd"}, 1)
        services.send(OpenBus(2, simulated))
        assert services.reply() is None
        shared.confirm(shared.buses[1])
        assert services.reply() == ("", {"engine_fd", "command_fd"}, 2)
        shared.confirm(shared.buses[1])
        assert services.reply() is None
        services.send(KeepBuses("a", (remote,)))
        assert [bus.number for bus in shared.buses] == [1, 2]
        services.send(KeepBuses("b", ()))
        assert [bus.number for bus in shared.buses] == [1]
        services.send(OpenBus(3, simulated))
        (failing,) = shared.buses[1:]
        assert shared.refuse(failing.key, "no slaves")
        assert services.reply() == ("no slaves", set(), 0)
        assert not shared.refuse(failing.key, "again")
        assert [bus.number for bus in shared.buses] == [1]
        services.send(OpenBus(4, BusSocket(PortName("a", "c"), interface="ethernet://nothere")))
        error, descriptors, _ = services.reply()
        assert "nothere" in error
        assert not descriptors


@pytest.mark.net
def test_a_pair_is_closed_with_the_rest():
    with ExitStack() as opened:
        one, other = open_message_pair(opened)
        assert one != other
    with pytest.raises(OSError, match="Bad file descriptor"):
        socket.dup(one)
