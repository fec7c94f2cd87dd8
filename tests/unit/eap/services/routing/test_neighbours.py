from __future__ import annotations

import asyncio
from ipaddress import IPv4Address

import pytest

from eap.errors import EnvironmentalError
from eap.ids import NetId
from eap.services.routing.neighbours import (
    Found,
    Introduction,
    Neighbour,
    find_neighbours,
    introduce,
)

MILL = Neighbour("mill", NetId.parse("10.0.0.2.1.1"), "10.0.0.2", "1.2.3")
SAW = Neighbour("saw", NetId.parse("10.0.0.3.1.1"), "10.0.0.3", "")


class Scanner:
    def __init__(self, *found, address="10.0.0.1"):
        self.address = IPv4Address(address)
        self.found = found
        self.asked = []

    async def introduce(self, wanted, address, *, wait_s):
        self.asked.append((wanted, address, wait_s))
        return 0

    async def scan(self, address="", *, wait_s):
        self.asked.append((address, wait_s))
        return list(self.found)


class Station:
    def __init__(self, *scanners):
        self.scanners = scanners
        self.learned = []

    def learn(self, net_id, name, address, now_ns):
        assert now_ns > 0
        self.learned.append((str(net_id), name, address))
        return name == "saw"


def test_all_networks_are_asked_and_each_router_is_told_once():
    both = Scanner(MILL), Scanner(MILL._replace(address="10.1.0.2"), SAW)
    station = Station(*both)
    found = asyncio.run(find_neighbours(station, "10.0.0.255", 0.5))
    assert found == [Found(MILL, False), Found(SAW, True)]
    assert station.learned[0] == ("10.0.0.2.1.1", "mill", "10.0.0.2")
    assert [each.asked for each in both] == [[("10.0.0.255", 0.5)]] * 2


def test_a_station_without_an_address_cannot_ask():
    with pytest.raises(EnvironmentalError, match="no IP address at which it serves AMS"):
        asyncio.run(find_neighbours(Station(), "", 0.5))


def test_a_router_is_asked_for_a_route_from_the_nearest_address():
    far, near = Scanner(address="192.168.7.1"), Scanner(address="10.0.0.1")
    wanted = Introduction("left", NetId.parse("10.0.0.1.1.1"), "me", "secret")
    told = introduce(Station(far, near), wanted, IPv4Address("10.0.0.9"), 2.0)
    assert asyncio.run(told) == 0
    assert (far.asked, near.asked) == ([], [(wanted, "10.0.0.9", 2.0)])
    with pytest.raises(EnvironmentalError, match="no IP address at which it serves AMS"):
        asyncio.run(introduce(Station(), wanted, IPv4Address("10.0.0.9"), 2.0))
