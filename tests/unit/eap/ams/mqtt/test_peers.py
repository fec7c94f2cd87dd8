from __future__ import annotations

import pytest

from eap.ads.endpoint import Endpoint
from eap.ams.mqtt import network as mqtt_peers
from eap.ams.mqtt.messages import Info
from eap.ams.mqtt.network import EXPIRY_NS, REFRESH_NS, Change, Peers
from eap.ams.routes import Origin, Route, RouteTable
from eap.ids import NetId

OWN, FAR, NEAR = (NetId.parse(each) for each in ("5.1.1.1.1.1", "6.1.1.1.1.1", "6.1.1.1.9.1"))
DOOR = "mqtt:hall"
HERE, GONE = Info("far", is_online=True), Info("far", is_online=False)


def peers_with(table: RouteTable | None = None) -> Peers:
    return Peers(OWN, DOOR, RouteTable() if table is None else table)


def test_router_comes_and_goes() -> None:
    peers = peers_with()
    told = [peers.update(FAR, each, 1) for each in (HERE, HERE, GONE, GONE, HERE)]
    assert told == [Change.UP, Change.NOTHING, Change.DOWN, Change.NOTHING, Change.UP]
    assert len(peers) == 1


def test_router_that_was_never_there_may_have_a_route_all_the_same() -> None:
    assert peers_with().update(FAR, GONE, 1) is Change.DOWN


def test_route_is_learned_and_expires() -> None:
    table = RouteTable()
    peers_with(table).update(FAR, HERE, 5)
    (route,) = table
    assert route == Route(
        FAR, "far", Endpoint(DOOR, str(FAR)), Origin.LEARNED, 4,
        expires_at_ns=5 + EXPIRY_NS, is_probed=False,
    )  # fmt: skip
    assert table.expire(5 + EXPIRY_NS) == [route]


def test_route_is_renewed_now_and_then_and_when_its_name_changes() -> None:
    table = RouteTable()
    peers = peers_with(table)
    peers.update(FAR, HERE, 0)
    version = table.version
    peers.update(FAR, HERE, REFRESH_NS // 3)
    assert table.version == version
    peers.update(FAR, HERE, REFRESH_NS)
    assert [each.expires_at_ns for each in table] == [REFRESH_NS + EXPIRY_NS]
    peers.update(FAR, HERE._replace(name=""), REFRESH_NS + 1)
    assert [each.name for each in table] == [str(FAR)]


def test_nothing_is_learned_that_is_not_to_be_learned() -> None:
    table = RouteTable([Route(FAR, "configured", Endpoint(DOOR, str(FAR)))])
    peers = peers_with(table)
    assert peers.update(FAR, HERE, 0) is Change.UP
    peers.update(NEAR, HERE._replace(is_unidirectional=True), 0)
    assert [each.origin for each in table] == [Origin.STATIC]
    table = RouteTable()
    assert Peers(OWN, DOOR, table, learns=False).update(FAR, HERE, 0) is Change.UP
    assert not len(table)


def test_hops_that_nothing_probes_are_awaited() -> None:
    table = RouteTable([
        Route(FAR, "far", Endpoint(DOOR, str(FAR)), is_probed=False),
        Route(NEAR, "near", Endpoint(DOOR, str(NEAR)), is_probed=False),
        Route(OWN, "probed", Endpoint(DOOR, str(OWN))),
        Route(OWN, "elsewhere", Endpoint("mqtt:line", str(OWN)), is_probed=False),
    ])  # fmt: skip
    peers = peers_with(table)
    assert peers.missing() == [str(FAR), str(NEAR)]
    peers.update(FAR, HERE, 0)
    peers.update(NetId.parse("7.1.1.1.1.1"), HERE, 0)
    assert peers.missing() == [str(NEAR)]
    peers.update(FAR, GONE, 0)
    assert peers.missing() == [str(FAR), str(NEAR)]


def test_other_routers_of_this_computer_get_their_own_net_id_only() -> None:
    table = RouteTable()
    peers_with(table).update(NetId.parse("5.1.1.1.7.1"), HERE, 0)
    assert [each.octets for each in table] == [6]


def test_silent_routers_are_forgotten_and_their_routes_too() -> None:
    table = RouteTable()
    peers = peers_with(table)
    peers.update(FAR, HERE, 1)
    peers.update(NEAR, GONE, 2)
    third = NetId.parse("7.1.1.1.1.1")
    peers.update(third, HERE, 10)
    assert peers.forget(5, 12) == ([FAR], [NEAR])
    assert len(peers) == 1
    assert [each.net_id for each in table.expire(12)] == [FAR]
    assert [each.net_id for each in table] == [third]


def test_route_that_somebody_added_meanwhile_is_not_forgotten() -> None:
    table = RouteTable()
    peers = peers_with(table)
    peers.update(FAR, HERE, 1)
    table.add(Route(FAR, "added", Endpoint(DOOR, str(FAR)), Origin.ADDED))
    peers.forget(5, 12)
    assert table.expire(12) == []
    assert [each.name for each in table] == ["added"]


def test_sender_is_behind_the_router_that_is_nearest() -> None:
    peers = peers_with()
    assert peers.address_of(NetId.parse("6.1.1.1.9.7")) == "6.1.1.1.9.7"
    peers.update(FAR, HERE, 0)
    peers.update(NEAR, HERE, 0)
    assert peers.address_of(NEAR) == "6.1.1.1.9.1"
    assert peers.address_of(NetId.parse("6.1.1.1.9.7")) == "6.1.1.1.9.1"
    assert peers.address_of(NetId.parse("6.1.1.1.2.1")) == "6.1.1.1.1.1"
    peers.update(FAR, GONE, 0)
    assert peers.address_of(NetId.parse("6.1.1.1.2.1")) == "6.1.1.1.9.1"
    assert peers.address_of(NetId.parse("6.1.2.1.2.1")) == "6.1.2.1.2.1"


def test_there_is_room_for_so_many(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mqtt_peers, "MAX_PEERS", 1)
    table = RouteTable()
    peers = peers_with(table)
    peers.update(FAR, HERE, 0)
    assert peers.update(NEAR, HERE, 0) is Change.IGNORED
    assert peers.update(FAR, GONE, 0) is Change.DOWN
    assert len(table) == 1
