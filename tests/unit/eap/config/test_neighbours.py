from __future__ import annotations

import pytest

from eap.aoe.spec import DoorKind, HopSpec
from eap.config.neighbours import find_hop

LEFT = '{name: eap0, kind: eap, interface: "udp://127.0.9.1", net_id: 127.0.9.1.2.1}'
RIGHT = '{name: eap0, kind: eap, interface: "udp://127.0.9.2", net_id: 127.0.9.2.2.1}'


def port(name, uri, net_id, more=""):
    return f'{{name: {name}, kind: eap, interface: "{uri}", net_id: {net_id}{more}}}'


def left(*uris, more=""):
    ports = [port(f"eap{n}", uri, f"127.0.9.1.2.{n + 1}", more) for n, uri in enumerate(uris)]
    return LEFT, "\n      - ".join(ports)


def right(*uris, more=""):
    ports = [port(f"eap{n}", uri, f"127.0.9.2.2.{n + 1}", more) for n, uri in enumerate(uris)]
    return RIGHT, "\n      - ".join(ports)


@pytest.fixture
def hop(index):
    def of(*edits, **wanted):
        plant = index(*edits)
        return find_hop(plant, plant.stations["left"], plant.stations["right"], **wanted)

    return of


def test_udp_ports_reach_each_other_at_their_addresses(hop):
    assert hop() == HopSpec(DoorKind.UDP, "eap0", "127.0.9.2:34980")
    assert hop(right("udp://127.0.9.2:40000")).address == "127.0.9.2:40000"


@pytest.mark.parametrize(
    ("mine", "theirs"),
    [("udp", "tcp"), ("tcp", "udp"), ("tcp", "tcp")],
)
def test_where_one_has_no_udp_it_is_a_tcp_connection(hop, mine, theirs):
    found = hop(left(f"{mine}://127.0.9.1"), right(f"{theirs}://127.0.9.2"))
    assert found == HopSpec(DoorKind.TCP, "eap0", "127.0.9.2:34980")


def test_on_ethernet_a_port_is_its_mac_address_or_its_net_id(hop):
    line = left("ethernet://eth0")
    by_net_id = hop(line, right("ethernet://eth0"))
    assert by_net_id == HopSpec(DoorKind.ETHERNET, "eap0", "127.0.9.2.2.1")
    by_mac = hop(line, right("ethernet://eth0", more=", mac: 02-00-00-00-00-0A"))
    assert by_mac.address == "02:00:00:00:00:0a"


@pytest.mark.parametrize(
    ("mine", "theirs", "more"),
    [
        ("ethernet://eth0", "ethernet://eth1", ""),
        ("ethernet://eth0", "ethernet://eth0", ", vlan: {id: 3}"),
        ("ethernet://eth0", "udp://127.0.9.2", ""),
        ("loop://line", "loop://line", ""),
        ("udp://10.0.0.1", "udp://127.0.9.2", ""),
        ("udp://127.0.9.1", "udp://0.0.0.0", ""),
    ],
)
def test_what_is_not_shared_is_no_way(hop, mine, theirs, more):
    assert hop(left(mine), right(theirs, more=more)) is None


def test_interfaces_of_other_names_are_one_wire_if_somebody_says_so(hop):
    found = hop(left("ethernet://eth0"), right("ethernet://eth1"), other="eap0")
    assert found == HopSpec(DoorKind.ETHERNET, "eap0", "127.0.9.2.2.1")


def test_of_several_ways_the_one_in_the_same_network_is_taken_udp_before_others(hop):
    both = [left("udp://10.1.0.1", "udp://10.2.0.1"), right("udp://10.2.0.2", "udp://10.3.0.2")]
    assert hop(*both) == HopSpec(DoorKind.UDP, "eap1", "10.2.0.2:34980")
    mixed = [left("ethernet://eth0", "udp://10.2.0.1"), right("ethernet://eth0", "udp://10.9.0.2")]
    assert hop(*mixed) == HopSpec(DoorKind.UDP, "eap1", "10.9.0.2:34980")


def test_a_port_that_is_named_is_the_only_one_that_counts(hop):
    both = [left("udp://10.1.0.1", "udp://10.2.0.1"), right("udp://10.2.0.2", "udp://10.3.0.2")]
    assert hop(*both, own="eap0").port == "eap0"
    assert hop(*both, other="eap1").address == "10.3.0.2:34980"
    assert hop(*both, other="eap9") is None
