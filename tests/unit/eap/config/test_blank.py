"""A station that no plant file describes."""

from __future__ import annotations

import pytest

from eap.config.blank import INTERFACE_PATH, NET_ID_PATHS, blank
from eap.pd.spec import PortKind, PortSpec, StationSpec


def test_one_port_and_nothing_else():
    result = blank("mixer", "udp://10.0.0.4", "10.0.0.4.2.1", 5000)
    port = PortSpec("eap0", PortKind.EAP, "udp://10.0.0.4", "10.0.0.4.2.1")
    assert result.findings == ()
    assert result.plant is not None
    assert result.plant.name == "mixer"
    assert result.plant.stations == (StationSpec("mixer", "10.0.0.4.1.1", 5000, (port,)),)


def test_the_router_has_a_net_id_of_its_own():
    result = blank("mixer", "udp://10.0.0.4", "1.2.3.4.0.9", 5000)
    assert result.plant is not None
    assert result.plant.stations[0].net_id == "1.2.3.4.255.9"


@pytest.mark.parametrize(
    ("name", "interface", "net_id", "paths"),
    [
        ("mi/xer", "udp://10.0.0.4", "10.0.0.4.2.1", ["station"]),
        ("mixer", "upd://10.0.0.4", "10.0.0.4.2.1", [INTERFACE_PATH]),
        ("mixer", "sim://bus.yaml", "10.0.0.4.2.1", [INTERFACE_PATH]),
        ("mixer", "udp://239.1.1.1", "10.0.0.4.2.1", [INTERFACE_PATH]),
        ("mixer", "udp://10.0.0.4", "10.0.0.4", [NET_ID_PATHS[1]]),
        ("mixer", "udp://10.0.0.4", "0.0.0.0.0.0", [NET_ID_PATHS[0]]),
        ("mixer", "udp://10.0.0.4", "0.0.0.0.1.0", [NET_ID_PATHS[1]]),
    ],
)
def test_the_rules_of_plant_files_hold(name, interface, net_id, paths):
    result = blank(name, interface, net_id, 5000)
    assert result.plant is None
    assert [finding.path for finding in result.findings] == paths
