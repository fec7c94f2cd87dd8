from __future__ import annotations

import pytest

from eap.aoe.spec import DoorKind, HopSpec, RouteSpec, RoutingSpec
from eap.appliance.durable import seal
from eap.appliance.route_store import (
    AppliedRouting,
    RouteStore,
    RoutingStore,
    bring_routes_back,
    set_routes_aside,
)
from eap.appliance.station_file import VERSION
from eap.errors import EnvironmentalError

ROUTES = (
    RouteSpec(name="plc", net_id="5.1.2.3.1.1", hop=HopSpec(DoorKind.AMS_TCP, "", "plc:48898")),
)


@pytest.fixture
def store(tmp_path, monkeypatch):
    monkeypatch.setenv("EAP_STATE_DIR", str(tmp_path))
    return RouteStore("demo", "left")


def test_routes_come_back(store, tmp_path):
    assert store.load() == ()
    store.save(ROUTES)
    assert RouteStore("demo", "left").load() == ROUTES
    assert RouteStore("demo", "right").load() == ()
    assert store.path == tmp_path / "demo/routes/left.json"
    store.save(())
    assert store.load() == ()


@pytest.mark.parametrize("data", [b"", b"[]", seal(b"[]", VERSION)[:-2], seal(b"[1]", VERSION)])
def test_a_damaged_file_is_put_aside(store, caplog, data):
    store.save(ROUTES)
    store.path.write_bytes(data)
    assert store.load() == ()
    assert "cannot be used" in caplog.text
    assert "left.damaged" in caplog.text
    assert not store.path.exists()


def test_what_cannot_be_read_or_written_says_so(store, caplog):
    store.path.mkdir(parents=True)
    assert store.load() == ()
    assert "cannot be read (Is a directory)" in caplog.text
    with pytest.raises(EnvironmentalError, match=r"routes cannot be kept in .*; set EAP_STATE_DIR"):
        store.save(ROUTES)


def test_what_was_applied_is_kept_beside_the_added_routes(store, tmp_path):
    routing = RoutingStore("demo", "left")
    assert routing.read() is None
    applied = AppliedRouting(base="x", spec=RoutingSpec(routes=ROUTES), previous=RoutingSpec())
    routing.save(applied)
    assert RoutingStore("demo", "left").read() == applied
    assert store.load() == ()
    assert routing.path == tmp_path / "demo/routing/left.json"


def test_a_station_can_start_as_if_nothing_was_kept_and_go_on_with_it_later(store):
    store.save(ROUTES)
    set_routes_aside("demo", "left")
    assert store.load() == ()
    bring_routes_back("demo", "left")
    assert store.load() == ROUTES
    set_routes_aside("demo", "left")
    store.save(())
    bring_routes_back("demo", "left")
    assert store.load() == ()
