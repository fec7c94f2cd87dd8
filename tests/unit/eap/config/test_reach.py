from __future__ import annotations

import pytest

from eap.config.reach import net_ids_of, prefixes, reach, without_prefix
from eap.config.structs import Route


def test_a_station_whose_net_ids_begin_alike_is_reached_by_four_octets(index):
    plant = index()
    assert without_prefix(plant) == set()
    assert net_ids_of(plant.stations["left"], set()) == [("127.0.9.1.1.1", 4)]


@pytest.mark.parametrize(
    ("old", "new", "loose"),
    [
        ("net_id: 127.0.9.2.1.1", "net_id: 5.5.5.5.1.1", {"right"}),
        ("net_id: 127.0.9.1.2.1", "net_id: 127.0.9.2.9.9", {"left", "right"}),
    ],
)
def test_others_are_reached_by_each_of_their_net_ids(index, old, new, loose):
    plant = index((old, new))
    assert without_prefix(plant) == loose
    found = net_ids_of(plant.stations["right"], loose)
    assert [octets for _, octets in found] == [6, 6]
    assert found[1][0] == "127.0.9.2.2.1"


def test_net_ids_that_are_none_are_passed_over(index):
    plant = index(("net_id: 127.0.9.2.1.1", "net_id: what"))
    assert prefixes(plant.stations["right"]) == {bytes((127, 0, 9, 2))}


@pytest.mark.parametrize(
    ("route", "found"),
    [
        (Route(to="default"), [("0.0.0.0.0.0", 0)]),
        (Route(to="plc", net_id="5.1.2.3.1.1"), [("5.1.2.3.1.1", 4)]),
        (Route(to="plc", net_id="5.1.2.3.1.1", octets=6), [("5.1.2.3.1.1", 6)]),
        (Route(to="left"), [("127.0.9.1.1.1", 6), ("127.0.9.1.2.1", 6)]),
        (Route(to="left", virtual="9.9.9.9.1.1"), [("127.0.9.1.1.1", 4)]),
    ],
)
def test_a_route_is_for_the_net_ids_of_its_target(index, route, found):
    assert reach(index(), route, {"left"}) == found
