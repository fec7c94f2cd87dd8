from __future__ import annotations

import pytest

from eap.aoe.spec import (
    AccessRule,
    AmsUser,
    DirectoryPort,
    DirectoryStation,
    DoorKind,
    HopSpec,
    RouteSpec,
)

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


def routes(*items):
    return LEFT_PORT, f"{LEFT_PORT}\n    routes: [{', '.join(items)}]"


def test_a_route_that_is_written_stands_for_the_derived_ones(plant):
    item = "{to: right, virtual: 9.9.9.9.1.1, unidirectional: true, timeout_ms: 50, probe: false}"
    assert plant(routes(item)).routing["left"].routes == (
        RouteSpec(
            name="right",
            net_id="127.0.9.2.1.1",
            hop=HopSpec(DoorKind.UDP, "eap0", "127.0.9.2:34980"),
            router="127.0.9.2.1.1",
            virtual="9.9.9.9.1.1",
            is_unidirectional=True,
            timeout_ms=50,
            is_probed=False,
        ),
    )


def test_what_is_written_comes_first(plant):
    found = plant(routes("{to: default, via: 127.0.9.77}")).routing["left"].routes
    assert [(route.name, route.octets, route.is_derived) for route in found] == [
        ("default", 0, False),
        ("right", 4, True),
    ]
    assert (found[0].net_id, found[0].router) == ("0.0.0.0.0.0", "")


def test_stations_that_share_but_a_network_reach_each_other_by_its_broker(plant):
    broker = "    routes: [{mqtt: mqtt://b, network: n}]"
    right = '"udp://127.0.9.2", net_id: 127.0.9.2.2.1}'
    told = plant(
        ("to: 127.0.9.2}", "to: 239.1.1.1}"),
        (LEFT_PORT, LEFT_PORT.replace("udp://127.0.9.1", "udp://10.0.0.1") + f"\n{broker}"),
        (right, f"{right}\n{broker}"),
    ).routing["left"]
    assert [route.hop for route in told.routes] == [HopSpec(DoorKind.MQTT, "n", "127.0.9.2.1.1")]
    assert not told.routes[0].is_probed
    assert [each.host for each in told.mqtt] == ["b"]


def test_rules_users_and_learning_are_told(plant, tmp_path):
    more = """
    access: [{name: a, allow: [all]}]
    learn: false
    users: [{name: me, password_file: line.yaml}]"""
    told = plant((LEFT_PORT, LEFT_PORT + more)).routing["left"]
    assert told.access == (AccessRule("a"),)
    assert told.users == (AmsUser("me", str(tmp_path / "line.yaml")),)
    assert not told.learn
