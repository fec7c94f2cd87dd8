from __future__ import annotations

from typing import Any

import msgspec
import pytest

from eap.ams.directory import Directory
from eap.ams.routes import Route
from eap.ams.spec import DirectoryStation
from eap.codec.ams import AmsAnswer
from eap.errors import ControlError
from eap.ids import Endpoint, NetId
from eap.services.control.route_methods import AmsMethods
from eap.services.routing.station_router import StationRouter
from eap.services.routing.tracing import RouteQuery
from tests.support.routing import StubService
from tests.support.virtualtime import run_virtual

NET_ID = NetId.parse("5.1.1.1.1.1")
PLANT = Directory([DirectoryStation("island-01", NET_ID, ())])


def call(method: str, **params: Any) -> Any:
    async def get() -> Any:
        router = StationRouter("island-01", NET_ID)
        router.add_service(
            NET_ID,
            RouteQuery(router, StubService(lambda _: AmsAnswer(bytes(4) + b"\5\0\0\0"), 10_000)),
        )
        router.add_route(
            Route(NetId.parse("6.1.1.1.1.1"), "far", Endpoint("udp:none", "10.0.0.6:34980"))
        )
        methods = AmsMethods({"island-01": router}, PLANT, {"island-01": "127.0.1.1"}.__getitem__)
        return msgspec.to_builtins(await methods.table()[method](params))

    return run_virtual(get())


def test_trace_of_a_local_target() -> None:
    found = call("trace", target="island-01")
    assert (found["address"], found["name"]) == ("5.1.1.1.1.1:10000", "island-01")
    assert (found["ok"], found["why"]) == (True, "")
    (hop,) = found["hops"]
    assert (hop["station"], hop["net_id"], hop["opaque"]) == ("island-01", str(NET_ID), False)
    services = ("read", "write", "control", "files", "raw", "configure")
    assert hop["may"] == dict.fromkeys(services, True)
    assert hop["took_us"] == hop["spent_us"]
    answer = found["answer"]
    assert (answer["error"], answer["text"], answer["ads_state"]) == (0, "", 5)


def test_trace_that_ends_before_its_target() -> None:
    found = call("trace", target="6.1.1.1.3.1:1001", via="island-01")
    assert (found["ok"], found["name"], found["answer"]) == (False, "", None)
    assert found["why"] == ("island-01: route far is by udp:none, which this station does not have")
    assert found["hops"][0]["state"] == "down"


def test_scan_lists_stations() -> None:
    found = call("scan")
    assert found["via"] == {"station": "island-01", "address": "127.0.1.1"}
    assert [row["name"] for row in found["stations"]] == ["island-01", "far"]


def test_ams_ask_passes_any_request() -> None:
    answer = call("ams_ask", target="island-01", command=4)
    assert answer == {"error": 0, "data": "0000000005000000"}
    assert call("ams_ask", target="7.1.1.1.1.1:1", command=4)["error"] == 7


@pytest.mark.parametrize(
    ("method", "params", "text"),
    [
        ("trace", {"target": "island-1"}, "no station 'island-1' in this plant, did you mean"),
        ("trace", {"target": "island-01", "via": "x"}, "unknown station 'x'"),
        ("scan", {"via": "island"}, "unknown station 'island', did you mean island-01"),
        ("ams_ask", {"target": "island-01", "command": 0}, ">= 1"),
        ("ams_ask", {"target": "island-01", "command": 2, "data": "x"}, "hexadecimal"),
    ],
)
def test_ams_methods_refuse_unknown_names(method: str, params: dict[str, Any], text: str) -> None:
    with pytest.raises(ControlError, match=text):
        call(method, **params)
