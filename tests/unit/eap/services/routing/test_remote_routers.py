from __future__ import annotations

from ipaddress import IPv4Address

import pytest

from eap.errors import EnvironmentalError
from eap.ids import NetId
from eap.services.routing.remote_routers import (
    FoundRouter,
    RemoteRouter,
    RemoteRouteRequest,
    add_remote_route,
    scan_routers,
)
from tests.support.virtualtime import run_virtual

MILL = RemoteRouter("mill", NetId.parse("10.0.0.2.1.1"), "10.0.0.2", "1.2.3")
SAW = RemoteRouter("saw", NetId.parse("10.0.0.3.1.1"), "10.0.0.3", "")


class NeighbourScanner:
    def __init__(self, *found, address="10.0.0.1"):
        self.address = IPv4Address(address)
        self.found = found
        self.asked = []

    async def add_remote_route(self, wanted, address, *, wait_s):
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


def test_scan_routers_asks_all_networks_and_lists_each_router_once():
    both = NeighbourScanner(MILL), NeighbourScanner(MILL._replace(address="10.1.0.2"), SAW)
    station = Station(*both)
    found = run_virtual(scan_routers(station.scanners, station.learn, "10.0.0.255", 0.5))
    assert found == [FoundRouter(MILL, False), FoundRouter(SAW, True)]
    assert station.learned[0] == ("10.0.0.2.1.1", "mill", "10.0.0.2")
    assert [each.asked for each in both] == [[("10.0.0.255", 0.5)]] * 2


def test_station_without_an_address_cannot_scan():
    with pytest.raises(EnvironmentalError, match="no IP address at which it serves AMS"):
        run_virtual(scan_routers([], Station().learn, "", 0.5))


def test_add_remote_route_uses_the_nearest_address():
    far, near = NeighbourScanner(address="192.168.7.1"), NeighbourScanner(address="10.0.0.1")
    wanted = RemoteRouteRequest("left", NetId.parse("10.0.0.1.1.1"), "me", "secret")
    told = add_remote_route([far, near], wanted, IPv4Address("10.0.0.9"), 2.0)
    assert run_virtual(told) == 0
    assert (far.asked, near.asked) == ([], [(wanted, "10.0.0.9", 2.0)])
    with pytest.raises(EnvironmentalError, match="no IP address at which it serves AMS"):
        run_virtual(add_remote_route([], wanted, IPv4Address("10.0.0.9"), 2.0))
