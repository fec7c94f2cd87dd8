from __future__ import annotations

import re

import pytest

from eap.ams.directory import Directory
from eap.ams.spec import DirectoryPort, DirectoryStation
from eap.ids import NetId

PORTS = (
    DirectoryPort(
        "eap0", is_bus=False, net_id=NetId.parse("5.1.1.1.2.1"), interface="udp://127.0.1.1"
    ),
    DirectoryPort(
        "bus0",
        is_bus=True,
        net_id=NetId.parse("5.1.1.1.3.1"),
        interface="sim://x.yaml",
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
        ("9.8.7.6.1.300", "'9.8.7.6.1.300' has an octet above 255"),
    ],
)  # fmt: skip
def test_what_is_no_name_here(text: str, reason: str) -> None:
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
