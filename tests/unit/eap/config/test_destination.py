from __future__ import annotations

import pytest

from eap.config.destination import group_of, reaches, resolve
from eap.config.structs import Port, Vlan
from eap.ids import Destination, InterfaceUri
from eap.pd.spec import PortKind


def port(interface, **options):
    made = Port(name="p", kind=PortKind.EAP, interface=interface, net_id="1.1.1.1.1.1", **options)
    return made, InterfaceUri.parse(interface)


@pytest.mark.parametrize(
    ("text", "interface", "destination"),
    [
        ("10.0.0.2", "udp://10.0.0.1", "10.0.0.2"),
        ("10.0.0.2:4000", "udp://10.0.0.1", "10.0.0.2:4000"),
        ("tcp://10.0.0.2", "udp://10.0.0.1", "tcp://10.0.0.2"),
        ("tcp://10.0.0.2", "tcp://10.0.0.1", "tcp://10.0.0.2"),
        ("broadcast", "udp://10.0.0.1", "255.255.255.255"),
        ("broadcast", "ethernet://eth0", "ff:ff:ff:ff:ff:ff"),
        ("multicast", "ethernet://eth0", "01:01:05:04:00:00"),
        ("02-00-00-00-00-01", "ethernet://eth0", "02:00:00:00:00:01"),
        ("right/eap0", "udp://127.0.9.1", "127.0.9.2"),
        ("right/eap0", "tcp://127.0.9.1", ValueError),  # the port takes no TCP
        ("right/eap0", "ethernet://eth0", ValueError),
        ("right/eap9", "udp://127.0.9.1", ValueError),
        ("multicast", "udp://127.0.9.1", ValueError),
        ("broadcast", "tcp://127.0.9.1", ValueError),
        ("tcp://239.1.1.1", "udp://127.0.9.1", ValueError),
        ("10.0.0.2", "tcp://10.0.0.1", ValueError),
        ("10.0.0.2", "ethernet://eth0", ValueError),
        ("02:00:00:00:00:01", "udp://10.0.0.1", ValueError),
        ("here", "udp://10.0.0.1", ValueError),
        ("127.0.9.2.2.1", "udp://127.0.9.1", "127.0.9.2"),  # of a port
        ("127.0.9.2.1.1", "udp://127.0.9.1", "127.0.9.2"),  # of a router
        ("5.5.5.5.1.1", "udp://127.0.9.1", ValueError),
        ("5.5.5.5.1.1", "ethernet://eth0", "5.5.5.5.1.1"),
        ("0.0.0.0.0.0", "ethernet://eth0", ValueError),
    ],
)
def test_what_may_be_written_becomes_an_address(index, text, interface, destination):
    if destination is ValueError:
        with pytest.raises(ValueError, match=r"."):
            resolve(text, InterfaceUri.parse(interface), index())
    else:
        assert str(resolve(text, InterfaceUri.parse(interface), index())) == destination


@pytest.mark.parametrize(
    ("interface", "sender", "destination"),
    [
        ("udp://127.0.9.2:4000", "udp://127.0.9.1", "127.0.9.2:4000"),
        ("tcp://127.0.9.2", "udp://127.0.9.1", "tcp://127.0.9.2"),
        ("loop://line", "loop://line", "01:01:05:04:00:00"),
        ("ethernet://eth1", "ethernet://eth0", "127.0.9.2.2.1"),
    ],
)
def test_a_port_of_the_plant_has_an_address(index, interface, sender, destination):
    plant = index(('"udp://127.0.9.2"', f'"{interface}"'))
    assert str(resolve("right/eap0", InterfaceUri.parse(sender), plant)) == destination


def test_a_router_with_several_ports_has_no_address(index):
    plant = index(
        (
            "net_id: 127.0.9.2.2.1}",
            """net_id: 127.0.9.2.2.1}
      - {name: eap1, kind: eap, interface: "udp://127.0.9.3", net_id: 127.0.9.2.3.1}""",
        )
    )
    uri = InterfaceUri.parse("udp://127.0.9.1")
    assert str(resolve("127.0.9.2.3.1", uri, plant)) == "127.0.9.3"
    with pytest.raises(ValueError, match="with several ports: right/eap0, right/eap1"):
        resolve("127.0.9.2.1.1", uri, plant)


def test_a_udp_port_that_takes_tcp_has_a_tcp_address(index):
    plant = index(("net_id: 127.0.9.2.2.1", "net_id: 127.0.9.2.2.1, tcp: true"))
    uri = InterfaceUri.parse("tcp://127.0.9.1")
    assert str(resolve("right/eap0", uri, plant)) == "tcp://127.0.9.2"


@pytest.mark.parametrize(
    ("destination", "sender", "receiver", "arrives"),
    [
        ("1.1.1.1.1.1", port("ethernet://eth0"), port("ethernet://eth1"), True),
        ("1.1.1.1.1.1", port("ethernet://eth0"), port("ethernet://eth1", vlan=Vlan(id=2)), False),
        ("1.1.1.1.1.2", port("ethernet://eth0"), port("ethernet://eth1"), False),
        ("10.0.0.2", port("udp://10.0.0.1"), port("udp://10.0.0.2"), True),
        ("10.0.0.2", port("udp://10.0.0.1"), port("udp://10.0.0.3"), False),
        ("10.0.0.2", port("udp://10.0.0.1"), port("udp://0.0.0.0"), True),
        ("10.0.0.2", port("udp://10.0.0.1"), port("udp://10.0.0.2:4000"), False),
        ("10.0.0.2:34980", port("udp://10.0.0.1"), port("udp://10.0.0.2"), True),
        ("10.0.0.2", port("udp://10.0.0.1"), port("tcp://10.0.0.2"), False),
        ("239.1.1.1", port("udp://10.0.0.1"), port("udp://10.0.0.2"), True),
        ("255.255.255.255", port("udp://10.0.0.1"), port("udp://10.0.0.2"), True),
        ("10.0.0.255", port("udp://10.0.0.1"), port("udp://10.0.0.2"), False),
        ("10.0.0.255", port("udp://10.0.0.1"), port("udp://10.0.0.2", broadcast=True), True),
        ("tcp://10.0.0.2", port("tcp://10.0.0.1"), port("tcp://10.0.0.2"), True),
        ("tcp://10.0.0.2", port("udp://10.0.0.1"), port("udp://10.0.0.2"), False),
        ("tcp://10.0.0.2", port("udp://10.0.0.1"), port("udp://10.0.0.2", tcp=True), True),
        ("01:01:05:04:00:00", port("ethernet://a"), port("ethernet://b"), True),
        ("01:01:05:04:00:00", port("ethernet://a"), port("udp://10.0.0.1"), False),
        ("02:00:00:00:00:01", port("ethernet://a"), port("ethernet://b", vlan=Vlan(id=5)), False),
        (
            "02:00:00:00:00:01",
            port("ethernet://a", vlan=Vlan(id=5)),
            port("ethernet://b", vlan=Vlan(id=5, priority=3)),
            True,
        ),
        ("01:01:05:04:00:00", port("loop://a"), port("loop://a"), True),
        ("01:01:05:04:00:00", port("loop://a"), port("loop://b"), False),
        ("01:01:05:04:00:00", port("ethernet://a"), port("loop://a"), False),
    ],
)
def test_a_frame_arrives_where_its_address_is(destination, sender, receiver, arrives):
    assert reaches(Destination.parse(destination), sender, receiver) is arrives


@pytest.mark.parametrize(
    ("destination", "group"),
    [
        ("10.0.0.2", None),
        ("255.255.255.255", None),
        ("239.1.1.1", "239.1.1.1"),
        ("01:01:05:04:00:00", None),  # every Ethernet port listens to it
        ("ff:ff:ff:ff:ff:ff", None),
        ("02:00:00:00:00:01", None),
        ("01:01:05:04:00:07", "01:01:05:04:00:07"),
    ],
)
def test_groups_are_what_one_has_to_join(destination, group):
    assert group_of(Destination.parse(destination)) == group
