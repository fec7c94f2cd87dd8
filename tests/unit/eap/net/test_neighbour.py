"""The neighbour table of a namespace of our own, whose entries the test writes."""

from __future__ import annotations

import socket

import pytest

from eap.ids import MacAddr
from eap.net.neighbour import Neighbour, NeighbourState, NeighbourTable, Route, RouteKind
from eap.pd.monitor import Evidence
from tests.unit.eap.net.conftest import ip

pytestmark = [pytest.mark.net, pytest.mark.root]

THERE = "10.77.0.2"
MAC = MacAddr.parse("02:00:00:00:00:02")


@pytest.fixture
def table(cable):
    ip(f"addr add 10.77.0.1/24 dev {cable[0]}")
    ip("route add 10.88.0.0/16 via 10.77.0.254")
    ip("route add blackhole 10.99.0.0/16")
    table = NeighbourTable()
    yield table
    table.close()


def set_state(state, address=THERE):
    ip(f"neigh replace {address} lladdr {MAC} dev left nud {state}")


def test_own_addresses_have_no_neighbour(table):
    for address in ("10.77.0.1", "127.0.0.1", "127.5.5.5"):
        assert table.route(address).kind is RouteKind.LOCAL
        assert table.look(address) is Evidence.BLIND


def test_routes(table):
    index = socket.if_nametoindex("left")
    assert table.route(THERE) == Route(RouteKind.DIRECT, index, THERE)
    assert table.route(THERE, "10.77.0.1").kind is RouteKind.DIRECT
    assert table.route("10.88.3.4") == Route(RouteKind.GATEWAY, index, "10.77.0.254")
    for nowhere in ("10.99.0.1", "192.0.2.1", "10.77.0.255", "239.0.0.1"):
        assert table.route(nowhere).kind is RouteKind.NONE
        assert table.look(nowhere) is Evidence.BLIND


def test_no_entry_is_nothing_new(table):
    assert table.neighbour(THERE, socket.if_nametoindex("left")) is None
    assert table.look(THERE) is Evidence.PENDING


@pytest.mark.parametrize(
    ("state", "evidence"),
    [
        ("reachable", Evidence.SEEN),
        ("stale", Evidence.PENDING),
        ("failed", Evidence.ABSENT),
        ("permanent", Evidence.BLIND),
        ("noarp", Evidence.BLIND),
    ],
)
def test_states(table, state, evidence):
    set_state(state)
    assert table.look(THERE, "10.77.0.1") is evidence
    entry = table.neighbour(THERE, socket.if_nametoindex("left"))
    known = None if state == "failed" else MAC  # a failed one has lost its address
    assert entry == Neighbour(NeighbourState[state.upper()], known)


def test_behind_a_gateway_only_that_the_gateway_is_gone(table):
    for state, evidence in (("reachable", Evidence.BLIND), ("failed", Evidence.ABSENT)):
        set_state(state, "10.77.0.254")
        assert table.look("10.88.3.4") is evidence


def test_question_at_the_wrong_interface_is_answered_with_nothing(table):
    set_state("reachable")
    assert table.neighbour(THERE, 9999) is None
