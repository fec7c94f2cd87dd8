"""Names of a plant, and hops as people write them."""

from __future__ import annotations

import re

import pytest

from eap.ams.directory import Directory, parse_via
from eap.ams.spec import DirectoryPort, DirectoryStation, HopSpec, TransportKind
from eap.ids import InterfaceUri, NetId

PORTS = (
    DirectoryPort(
        "eap0",
        is_bus=False,
        net_id=NetId.parse("5.1.1.1.2.1"),
        interface=InterfaceUri.parse("udp://127.0.1.1"),
    ),
    DirectoryPort(
        "bus0",
        is_bus=True,
        net_id=NetId.parse("5.1.1.1.3.1"),
        interface=InterfaceUri.parse("sim://x.yaml"),
        slaves={"drive": 1001, "io": 1002},
    ),
)
HERE = Directory([DirectoryStation("island-01", NetId.parse("5.1.1.1.1.1"), PORTS)])


@pytest.mark.parametrize(
    ("text", "address"),
    [
        ("island-01", "5.1.1.1.1.1:10000"),
        ("island-01/router", "5.1.1.1.1.1:65535"),
        ("island-01/eap0", "5.1.1.1.2.1:65535"),
        ("island-01/bus0", "5.1.1.1.3.1:65535"),
        ("island-01/bus0/drive", "5.1.1.1.3.1:1001"),
        ("island-01/bus0/1002", "5.1.1.1.3.1:1002"),
        ("island-01/bus0/1009", "5.1.1.1.3.1:1009"),
        ("9.8.7.6.1.1:851", "9.8.7.6.1.1:851"),
        ("9.8.7.6.1.1", "9.8.7.6.1.1:65535"),
    ],
)
def test_addresses_by_name(text: str, address: str) -> None:
    assert str(HERE.find(text)) == address


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("island-1", "no station 'island-1' in this plant, did you mean island-01?"),
        ("island-01/eap", "station island-01 has no port 'eap', did you mean eap0?"),
        ("island-01/x", "station island-01 has no port 'x'; it has eap0, bus0"),
        ("island-01/eap0/1001", "island-01/eap0 is no bus port, so there are no slaves behind it"),
        ("island-01/bus0/drv", "no slave 'drv' behind island-01/bus0, did you mean drive?"),
        ("island-01/bus0/", "no slave '' behind island-01/bus0; they are drive (1001), io (1002)"),
        ("9.8.7.6.1.1:70000", "'70000' in '9.8.7.6.1.1:70000' is no AMS port (0 to 65535)"),
        ("9.8.7.6.1.300", "'9.8.7.6.1.300' has a number above 255"),
    ],
)  # fmt: skip
def test_directory_refuses_unknown_names(text: str, reason: str) -> None:
    with pytest.raises(ValueError, match=f"^{re.escape(reason)}$"):
        HERE.find(text)


@pytest.mark.parametrize(
    ("net_id", "port", "name"),
    [
        ("5.1.1.1.1.1", 10000, "island-01"),
        ("5.1.1.1.1.1", 300, "island-01:300"),
        ("5.1.1.1.1.1", 0xFFFF, "island-01/router"),
        ("5.1.1.1.2.1", 0xFFFF, "island-01/eap0"),
        ("5.1.1.1.3.1", 1001, "island-01/bus0/drive"),
        ("5.1.1.1.3.1", 1009, "island-01/bus0:1009"),
        ("9.8.7.6.1.1", 851, ""),
    ],
)
def test_names_of_addresses(net_id: str, port: int, name: str) -> None:
    assert HERE.name_of(NetId.parse(net_id), port) == name


def test_station_of_a_net_id() -> None:
    assert HERE.station_of(NetId.parse("5.1.1.1.3.1")) == "island-01"
    assert not HERE.station_of(NetId.parse("9.8.7.6.1.1"))


def test_devices() -> None:
    assert str(HERE.find_device("island-01")) == "5.1.1.1.2.1:65535"
    assert str(HERE.find_device("island-01/bus0/drive")) == "5.1.1.1.3.1:1001"
    alone = Directory([DirectoryStation("x", NetId.parse("5.1.1.2.1.1"), ())])
    assert str(alone.find_device("x")) == "5.1.1.2.1.1:10000"
    with pytest.raises(ValueError, match="no station 'y'"):
        alone.find_device("y")


FAR = "9.1.1.1.1.1"


def station(number: int, *interfaces: str) -> DirectoryStation:
    ports = [
        DirectoryPort(
            f"eap{index}",
            False,
            NetId.parse(f"5.1.1.{number}.{index + 2}.1"),
            InterfaceUri.parse(interface),
        )
        for index, interface in enumerate(interfaces)
    ]
    bus = DirectoryPort(
        "bus0", True, NetId.parse(f"5.1.1.{number}.9.1"), InterfaceUri.parse("sim://x.yaml")
    )
    return DirectoryStation(f"s{number}", NetId.parse(f"5.1.1.{number}.1.1"), (*ports, bus))


OWN = station(1, "udp://10.0.0.1", "ethernet://eth0", "tcp://127.0.0.1")
PLANT = Directory([
    OWN,
    station(2, "udp://10.0.0.2"),
    station(3, "ethernet://eth0"),
    station(4, "tcp://10.0.0.4:40000"),
    station(5, "loop://x"),
    station(6, "udp://0.0.0.0"),
    station(7, "udp://127.0.0.7"),
])  # fmt: skip


@pytest.mark.parametrize(
    ("text", "hop"),
    [
        ("s2/eap0", HopSpec(TransportKind.UDP, "eap0", "10.0.0.2:34980")),
        ("s2", HopSpec(TransportKind.UDP, "eap0", "10.0.0.2:34980")),
        ("s3/eap0", HopSpec(TransportKind.ETHERNET, "eap1", "5.1.1.3.2.1")),
        ("s4/eap0", HopSpec(TransportKind.TCP, "eap0", "10.0.0.4:40000")),
        ("s7", HopSpec(TransportKind.TCP, "eap2", "127.0.0.7:34980")),
        ("ams-tcp:plc.hall", HopSpec(TransportKind.AMS_TCP, "", "plc.hall:48898")),
        ("ams-tcp:10.0.0.9:1000", HopSpec(TransportKind.AMS_TCP, "", "10.0.0.9:1000")),
        ("udp:10.0.0.9", HopSpec(TransportKind.UDP, "eap0", "10.0.0.9:34980")),
        ("tcp:10.0.0.9:1000", HopSpec(TransportKind.TCP, "eap0", "10.0.0.9:1000")),
        (
            "ethernet:02-00-00-00-00-09",
            HopSpec(TransportKind.ETHERNET, "eap1", "02:00:00:00:00:09"),
        ),
        ("ethernet:9.1.1.1.2.1", HopSpec(TransportKind.ETHERNET, "eap1", "9.1.1.1.2.1")),
        ("mqtt:line", HopSpec(TransportKind.MQTT, "line", FAR)),
        ("10.0.0.9", HopSpec(TransportKind.UDP, "eap0", "10.0.0.9:34980")),
        ("10.0.0.9:35000", HopSpec(TransportKind.UDP, "eap0", "10.0.0.9:35000")),
        ("tcp://10.0.0.9", HopSpec(TransportKind.TCP, "eap0", "10.0.0.9:34980")),
        ("02:00:00:00:00:09", HopSpec(TransportKind.ETHERNET, "eap1", "02:00:00:00:00:09")),
        ("9.1.1.1.2.1", HopSpec(TransportKind.ETHERNET, "eap1", "9.1.1.1.2.1")),
        ("mqtt:line/s5", HopSpec(TransportKind.MQTT, "line", "5.1.1.5.1.1")),
        ("mqtt:line/9.9.9.9.1.1", HopSpec(TransportKind.MQTT, "line", "9.9.9.9.1.1")),
    ],
)
def test_places(text: str, hop: HopSpec) -> None:
    assert parse_via(text, FAR, OWN, PLANT) == hop


def test_station_at_all_addresses_of_its_host_reaches_others_and_that_host() -> None:
    own = PLANT.stations["s6"]
    for name, address in (("s2", "10.0.0.2"), ("s7", "127.0.0.7")):
        assert parse_via(name, FAR, own, PLANT).address == f"{address}:34980"


def test_port_is_chosen() -> None:
    assert parse_via("tcp:127.0.0.9", FAR, OWN, PLANT, port="eap2").port == "eap2"
    with pytest.raises(ValueError, match="no EAP port here is on udp: eap2"):
        parse_via("udp:127.0.0.9", FAR, OWN, PLANT, port="eap2")
    with pytest.raises(ValueError, match=r"s1 has no EAP port 'eap9'; it has eap0, eap1, eap2"):
        parse_via("udp:127.0.0.9", FAR, OWN, PLANT, port="eap9")


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("nowhere", "neither a station of the plant nor one of STATION/PORT, ams-tcp:HOST"),
        ("mqtt:", "neither a station of the plant"),
        ("s1/eap0", "is this station itself"),
        ("s2/bus0", "has no EAP port 'bus0'; it has eap0"),
        ("s5", "no port of s1 shares an interface with it"),
        ("s6", "no port of s1 shares an interface with it"),
        ("udp:plc", "'plc' is no IPv4 address"),
        ("udp:10.0.0.9:0", "'0' is not a port"),
        ("ams-tcp:plc:x", "'x' is not a port"),
        ("ethernet:eth0", "is not a MAC address"),
        ("ethernet:1.2.3", "is not an AMS NetID"),
        ("mqtt:line/x", "is not an AMS NetID"),
    ],
)
def test_via_refuses_unknown_targets(text: str, reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        parse_via(text, FAR, OWN, PLANT)
