from __future__ import annotations

import pytest

from eap.aoe.spec import DirectoryPort, DirectoryStation, DoorKind, HopSpec, RouteSpec

LEFT_PORT = '"udp://127.0.9.1", net_id: 127.0.9.1.2.1}'
BUS = "{name: bus0, kind: bus, interface: sim://line.yaml, net_id: 127.0.9.1.3.1}"


@pytest.fixture
def plant(load_plant):
    def of(*edits):
        result = load_plant(*edits)
        assert result.findings == ()
        return result.plant

    return of


def test_stations_that_share_an_interface_have_routes_to_each_other(plant):
    assert plant().routing["left"].routes == (
        RouteSpec(
            name="right",
            net_id="127.0.9.2.1.1",
            hop=HopSpec(DoorKind.UDP, "eap0", "127.0.9.2:34980"),
            router="127.0.9.2.1.1",
            is_derived=True,
        ),
    )
    assert plant().routing["right"].routes[0].name == "left"


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("net_id: 127.0.9.2.1.1", "net_id: 5.5.5.5.1.1"),  # the router's is not like the port's
        ("net_id: 127.0.9.1.2.1", "net_id: 127.0.9.2.9.9"),  # the other station's begin like them
    ],
)
def test_net_ids_without_four_octets_to_themselves_have_a_route_each(plant, old, new):
    routes = plant((old, new)).routing["left"].routes
    assert [route.octets for route in routes] == [6, 6]
    assert routes[1].net_id == "127.0.9.2.2.1"
    assert routes[0].router == routes[1].router == routes[0].net_id


def test_the_directory_names_all_ports_and_slaves(plant):
    left = plant((LEFT_PORT, f"{LEFT_PORT}\n      - {BUS}")).directory[0]
    assert left == DirectoryStation(
        "left",
        "127.0.9.1.1.1",
        (
            DirectoryPort("eap0", False, "127.0.9.1.2.1", "udp://127.0.9.1"),
            DirectoryPort("bus0", True, "127.0.9.1.3.1", "sim://line.yaml", {"valves": 1001}),
        ),
    )
