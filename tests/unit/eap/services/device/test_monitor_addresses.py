"""Reports of UDP sockets on their targets, and the addresses that a handover opens."""

from __future__ import annotations

import socket
from contextlib import ExitStack

import pytest

from eap.errors import EnvironmentalError
from eap.ids import Destination
from eap.net.neighbour import NeighbourTable
from eap.pd.monitor import ProbeResult
from eap.runtime.handover import PortName
from eap.services.device import monitoring as monitor_ways
from eap.services.device.monitoring import (
    REFUSAL_NS,
    ProbeSockets,
    UdpSubscriberProbe,
    key_of,
)
from eap.supervisor.sockets import SharedSockets
from tests.unit.eap.conftest import eap_port, left, right

pytestmark = pytest.mark.net

SECOND = 1_000_000_000


@pytest.fixture
def closed():
    """An address of this machine where nobody listens."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(("127.9.2.9", 0))
        host, port = sock.getsockname()
    return Destination.parse(f"{host}:{port}")


@pytest.fixture
def endpoint():
    table = NeighbourTable()
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sock.bind(("127.9.2.8", 0))
    endpoint = UdpSubscriberProbe([sock], table, "127.9.2.8")
    yield endpoint
    endpoint.close()
    table.close()


def send(endpoint, target):
    endpoint.sockets[0].sendto(b"frame", (target.host, target.port))


def test_closed_port_of_a_subscriber_is_evidence(endpoint, closed):
    endpoint.watch([closed])
    send(endpoint, closed)
    assert endpoint.refused_targets(5 * SECOND) == {key_of(closed)}
    assert endpoint.refused_targets(5 * SECOND) == set()
    assert endpoint.evidence_of(closed, 5 * SECOND) is ProbeResult.ABSENT


def test_refusal_holds_until_frames_went_on_without_another(endpoint, closed):
    endpoint.watch([closed])
    send(endpoint, closed)
    endpoint.refused_targets(5 * SECOND)
    assert endpoint.evidence_of(closed, 5 * SECOND + REFUSAL_NS - 1) is ProbeResult.ABSENT
    # The neighbour table has no entry for our own machine.
    assert endpoint.evidence_of(closed, 5 * SECOND + REFUSAL_NS) is ProbeResult.BLIND
    assert endpoint.evidence_of(closed, 5 * SECOND) is ProbeResult.BLIND


def test_unwatched_targets_are_ignored(endpoint, closed):
    endpoint.watch([closed])
    send(endpoint, closed)
    endpoint.watch([Destination.parse("127.9.2.9:9")])
    assert endpoint.refused_targets(5 * SECOND) == set()


def test_a_target_that_stays_keeps_its_refusal(endpoint, closed):
    endpoint.watch([closed])
    send(endpoint, closed)
    endpoint.refused_targets(5 * SECOND)
    endpoint.watch([closed, Destination.parse("127.9.2.9:9")])
    assert endpoint.evidence_of(closed, 5 * SECOND) is ProbeResult.ABSENT


def test_probe_without_targets_does_not_query_the_kernel(endpoint, closed):
    send(endpoint, closed)
    assert endpoint.refused_targets(SECOND) == set()
    endpoint.watch([])
    send(endpoint, closed)
    endpoint.watch([closed])
    assert endpoint.refused_targets(SECOND) == set()


def test_more_errors_than_one_call_takes(endpoint, closed):
    endpoint.watch([closed])
    for _ in range(600):
        send(endpoint, closed)
        endpoint.sockets[0].getsockopt(socket.SOL_SOCKET, socket.SO_ERROR)
    assert endpoint.refused_targets(5 * SECOND) == {key_of(closed)}
    assert endpoint.refused_targets(6 * SECOND) == set()


def test_listener_of_this_machine_is_unknown(endpoint):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as listener:
        listener.bind(("127.9.2.9", 0))
        target = Destination.parse("{}:{}".format(*listener.getsockname()))
        endpoint.watch([target])
        send(endpoint, target)
        assert endpoint.refused_targets(SECOND) == set()
        assert endpoint.evidence_of(target, SECOND) is ProbeResult.BLIND


def test_usual_port_has_no_need_to_be_named():
    assert key_of(Destination.parse("10.0.0.1")) == ("10.0.0.1", 34980)


def probes_of(sockets, opened, *stations):
    probes = ProbeSockets(opened)
    probes.follow(sockets.fit(stations), lambda name: eap_port(1))
    return probes


def test_every_udp_port_has_a_way(tmp_path):
    with SharedSockets(tmp_path / "control") as sockets, ExitStack() as opened:
        endpoints = probes_of(sockets, opened, left(), right()).probes
        assert set(endpoints.udp) == {PortName("left", "eap0"), PortName("right", "eap0")}
        assert endpoints.arp == {}
        for endpoint in endpoints.udp.values():
            assert len({sock.getsockname() for sock in endpoint.sockets}) == 1
            assert len(endpoint.sockets) == 2


def test_without_a_neighbour_table_icmp_has_to_do(tmp_path, monkeypatch, caplog, closed):
    def refuse():
        raise EnvironmentalError("the neighbour table cannot be read: forbidden")

    monkeypatch.setattr(monitor_ways, "NeighbourTable", refuse)
    with SharedSockets(tmp_path / "control") as sockets, ExitStack() as opened:
        endpoints = probes_of(sockets, opened, left(), right()).probes
        endpoint = endpoints.udp[PortName("left", "eap0")]
        assert endpoint.evidence_of(closed, 0) is ProbeResult.BLIND
    assert "forbidden; missing subscribers on UDP are detected by ICMP only" in caplog.text


def test_probes_follow_the_ports(tmp_path):
    with SharedSockets(tmp_path / "control") as sockets, ExitStack() as opened:
        made = probes_of(sockets, opened, left())
        first = made.probes.udp[PortName("left", "eap0")]
        made.follow(sockets.fit([left(), right()]), lambda name: eap_port(1))
        assert made.probes.udp[PortName("left", "eap0")] is first
        second = made.probes.udp[PortName("right", "eap0")]
        made.follow(sockets.fit([right()]), lambda name: eap_port(1))
        assert made.probes.udp == {PortName("right", "eap0"): second}
        assert {sock.fileno() for sock in first.sockets} == {-1}
