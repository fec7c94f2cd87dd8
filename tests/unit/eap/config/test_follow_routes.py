"""Where the routes of three stations lead that all see each other."""

from __future__ import annotations

import pytest

from eap.config.load import load

NAMES = ("west", "middle", "east")
NORTH = "to: north, net_id: 9.9.9.9.1.1"


def plant(routes):
    text = "plant: chain\nstations:\n"
    for number, name in enumerate(NAMES, 1):
        uri, net_id = f"udp://127.0.9.{number}", f"127.0.9.{number}"
        port = f'{{name: eap0, kind: eap, interface: "{uri}", net_id: {net_id}.2.1}}'
        text += f"  - name: {name}\n    net_id: {net_id}.1.1\n    ports: [{port}]\n"
        items = "".join(f"      - {{{item}}}\n" for item in routes.get(name, ()))
        text += f"    routes:\n{items}" if items else ""
    return text


@pytest.fixture
def warnings(tmp_path):
    def of(*edit, **routes):
        path = tmp_path / "plant.yaml"
        path.write_text(plant(routes).replace(*edit) if edit else plant(routes))
        result = load(path, lambda file: ())
        assert result.findings == ()
        return [f"{each.line}: {each.message}" for each in result.warnings]

    return of


@pytest.mark.parametrize(
    "routes",
    [
        {},
        {"west": ["to: east, via: middle/eap0"]},
        {"west": [f"{NORTH}, via: middle/eap0"], "middle": [f"{NORTH}, ams_tcp: north"]},
        {"west": [f"{NORTH}, via: middle/eap0"], "middle": ["to: default, via: 127.0.9.77"]},
        {"west": [f"{NORTH}, via: 127.0.9.77"]},
        {"west": ["to: default, via: middle/eap0"]},
        {"west": [f"{NORTH}, via: middle/eap0"], "middle": ["mqtt: mqtt://b, network: n, user: a"]},
        {"west": ["to: north, net_id: 9.9.9.9.1.1, virtual: 8.8.8.8.1.1, via: middle/eap0"],
         "middle": [f"{NORTH}, ams_tcp: north"]},
    ],
)  # fmt: skip
def test_routes_that_get_there_or_may_do_so_are_no_warning(warnings, routes):
    assert warnings(**routes) == []


def test_a_circle_is_named_at_each_route_of_it(warnings):
    assert warnings(
        west=[f"{NORTH}, via: middle/eap0"],
        middle=[f"{NORTH}, via: east/eap0"],
        east=[f"{NORTH}, via: west/eap0"],
    ) == [
        "7: the route to 'north' runs in a circle: west -> middle -> east -> west",
        "12: the route to 'north' runs in a circle: middle -> east -> west -> middle",
        "17: the route to 'north' runs in a circle: east -> west -> middle -> east",
    ]


def test_a_circle_by_a_default_route_is_one_too(warnings):
    found = warnings(west=[f"{NORTH}, via: middle/eap0"], middle=["to: default, via: west/eap0"])
    assert found == ["7: the route to 'north' runs in a circle: west -> middle -> west"]


def test_a_route_that_ends_on_the_way_is_named(warnings):
    assert warnings(west=[f"{NORTH}, via: middle/eap0"]) == [
        "7: the route to 'north' ends at middle, which has none on to it"
    ]


def test_who_learns_nothing_has_no_route_by_a_broker(warnings):
    edit = "name: middle\n", "name: middle\n    learn: false\n"
    routes = {"west": [f"{NORTH}, via: middle/eap0"], "middle": ["mqtt: mqtt://b, network: n"]}
    assert len(warnings(*edit, **routes)) == 1


def test_stations_send_each_other_what_is_for_a_third(warnings):
    found = warnings(west=["to: east, via: middle/eap0"], middle=["to: east, via: west/eap0"])
    assert found == [
        "7: the route to 'east' runs in a circle: west -> middle -> west",
        "12: the route to 'east' runs in a circle: middle -> west -> middle",
    ]
