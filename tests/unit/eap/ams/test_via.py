from __future__ import annotations

import pytest

from eap.ams.directory import Directory, parse_via
from eap.ams.spec import DirectoryPort, DirectoryStation, HopSpec, TransportKind
from eap.ids import NetId

FAR = "9.1.1.1.1.1"


def station(number: int, *interfaces: str) -> DirectoryStation:
    ports = [
        DirectoryPort(f"eap{index}", False, NetId.parse(f"5.1.1.{number}.{index + 2}.1"), interface)
        for index, interface in enumerate(interfaces)
    ]
    bus = DirectoryPort("bus0", True, NetId.parse(f"5.1.1.{number}.9.1"), "sim://x.yaml")
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
def test_what_is_no_place_is_refused(text: str, reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        parse_via(text, FAR, OWN, PLANT)
