"""Control protocol by ADS: rates, parts of answers, and rules of other stations."""

from __future__ import annotations

import asyncio
import json
import struct
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from eap.ads.request import ReadWrite, decode_outcome, encode_query
from eap.ams.access import AccessList
from eap.ams.spec import AccessRule, AccessService
from eap.codec.ads import AdsError, IndexGroup
from eap.codec.ams import CONTROL_PORT, AmsAnswer, AmsHeader
from eap.control.by_ads import KEPT_S, ControlOffset
from eap.ids import Endpoint, NetId
from eap.services.control.control_ads import KEPT_BYTES, RATES, STATUS_S, ControlAds, RemoteControl
from eap.services.routing.service import LocalRequest
from eap.services.routing.station_router import StationRouter

NEAR, FAR = NetId.parse("5.1.1.1.1.1"), NetId.parse("5.2.2.2.1.1")
STATIONS = {"near": NEAR, "far": FAR}


class Appliance:
    """Two stations whose methods answer at once.

    Attributes:
        calls: Methods that were called.
        now_s: The time.
        values: Result of ``read``.
    """

    def __init__(self, **rules: AccessRule) -> None:
        self.calls: list[str] = []
        self.now_s = 1000.0
        self.values: Any = {}
        self.routers = {
            name: StationRouter(
                name, net_id, access=AccessList([rules[name]] if name in rules else [])
            )
            for name, net_id in STATIONS.items()
        }
        self.control = RemoteControl(self._call, self.routers, lambda: self.now_s)
        self.service = ControlAds("near", self.control)

    async def _call(self, method: str, params: dict[str, Any]) -> Any:
        self.calls.append(method)
        if method == "status":
            stations = [{"name": name} for name in STATIONS]
            wheres = ["near/eap0", "far", "far/eap0", "far ← pd", "farther"]
            return {"stations": stations, "findings": [{"where": each} for each in wheres]}
        if method == "pd_list":
            return [{"station": params["station"]}]
        return self.values

    def ask(
        self,
        offset: int,
        data: bytes,
        length: int = 60_000,
        *,
        host: str = "10.0.0.9",
        port: int = 1,
    ) -> tuple[int, bytes]:
        """Return result and data of the answer to a request from a host."""
        command, body = encode_query(ReadWrite(IndexGroup.CONTROL, offset, length, data))
        source = NetId.parse("10.0.0.9.1.1")
        header = AmsHeader(NEAR, CONTROL_PORT, source, port, command)
        endpoint = Endpoint("ams-tcp", f"{host}:4000#1")

        async def answer() -> AmsAnswer:
            found = self.service.answer(LocalRequest(header, body, endpoint))
            return found if isinstance(found, AmsAnswer) else await found

        found = asyncio.run(answer())
        outcome = decode_outcome(command, found.error_code, found.data)
        return outcome.result, outcome.data

    def request(self, method: str, **params: Any) -> dict[str, Any]:
        """Return the answer to a request that has one part."""
        line = json.dumps({"v": 1, "id": 3, "method": method, "params": params}).encode()
        result, data = self.ask(ControlOffset.REQUEST, line)
        assert (result, data[:4]) == (0, bytes(4))
        document: dict[str, Any] = json.loads(data[8:])
        return document


def deny(service: AccessService) -> AccessRule:
    return AccessRule(name="no", allow=False, services=(service,))


def test_status_of_a_moment_serves_all_requests() -> None:
    appliance = Appliance()
    for _ in range(5):
        names = [each["name"] for each in appliance.request("status")["result"]["stations"]]
        assert names == ["near", "far"]
    assert appliance.calls == ["status"]
    appliance.now_s += STATUS_S + 0.01
    appliance.request("status")
    assert appliance.calls == ["status", "status"]


def test_station_that_must_not_be_read_is_in_no_answer() -> None:
    appliance = Appliance(far=deny(AccessService.READ))
    status = appliance.request("status")["result"]
    assert status["stations"] == [{"name": "near"}]
    assert [each["where"] for each in status["findings"]] == ["near/eap0", "farther"]
    assert appliance.request("pd_list")["result"] == [{"station": "near"}]
    refused = appliance.request("read", station="far")["error"]
    assert refused["code"] == "refused"
    assert "rule no refuses it" in refused["message"]
    assert appliance.request("read", station="near")["result"] == {}


def test_denied_request_about_another_station_is_audited_there() -> None:
    appliance = Appliance(far=deny(AccessService.READ))
    entries: list[Any] = []
    appliance.routers["far"].on_audit.append(entries.append)
    appliance.request("read", station="far")
    assert [(each.header.target, each.operations[0].decision.is_allowed) for each in entries] == [
        (FAR, False)
    ]


def test_client_beyond_its_rate_gets_error_4_and_others_are_served() -> None:
    appliance = Appliance()
    results = [
        appliance.ask(ControlOffset.REQUEST, b"{}", host="10.0.0.8")[0]
        for _ in range(RATES.source.burst + 5)
    ]
    assert results.count(AdsError.MAILBOX_FULL) == 5
    assert appliance.ask(ControlOffset.REQUEST, b"{}", host="10.0.0.7")[0] == 0
    appliance.now_s += 1
    assert appliance.ask(ControlOffset.REQUEST, b"{}", host="10.0.0.8")[0] == 0


def test_rest_of_an_answer_is_kept_for_its_client_and_a_time() -> None:
    appliance = Appliance()
    appliance.values = "x" * 500
    line = b'{"v": 1, "id": 3, "method": "read", "params": {"station": "near"}}'
    _, data = appliance.ask(ControlOffset.REQUEST, line, 108)
    ticket, total = struct.unpack_from("<II", data)
    assert len(data) == 108
    rest = struct.pack("<II", ticket, 100)
    assert appliance.ask(ControlOffset.PART, rest, 208, port=2)[0] == AdsError.NOT_FOUND
    result, more = appliance.ask(ControlOffset.PART, rest, 208)
    assert (result, struct.unpack_from("<II", more), len(more)) == (0, (ticket, total), 208)
    appliance.now_s += KEPT_S + 0.01
    assert appliance.ask(ControlOffset.PART, rest, 208)[0] == AdsError.NOT_FOUND


def test_answers_that_are_kept_are_bounded_in_bytes() -> None:
    appliance = Appliance()
    appliance.values = "x" * (KEPT_BYTES // 5)
    line = b'{"v": 1, "id": 3, "method": "read", "params": {"station": "near"}}'
    tickets = [
        struct.unpack_from("<I", appliance.ask(ControlOffset.REQUEST, line, 100)[1])[0]
        for _ in range(7)
    ]
    kept = [
        appliance.ask(ControlOffset.PART, struct.pack("<II", ticket, 0), 100)[0] == 0
        for ticket in tickets
    ]
    assert kept == [False] * 3 + [True] * 4


@pytest.mark.parametrize("position", [0, 1, 99, 10**6, 0xFFFF_FFFF])
@pytest.mark.parametrize("length", [0, 8, 9, 0xFFFF_FFFF])
def test_any_position_and_length_of_a_part_is_answered(position: int, length: int) -> None:
    appliance = Appliance()
    appliance.values = "x" * 500
    line = b'{"v": 1, "id": 3, "method": "read", "params": {"station": "near"}}'
    _, data = appliance.ask(ControlOffset.REQUEST, line, 20)
    (ticket,) = struct.unpack_from("<I", data)
    result, more = appliance.ask(ControlOffset.PART, struct.pack("<II", ticket, position), length)
    assert (result, len(more) <= 8 + len(data) + 600) == (0, True)


@given(st.binary(max_size=60) | st.text(max_size=40).map(str.encode))
def test_any_request_is_answered_with_a_line_of_the_protocol(line: bytes) -> None:
    result, data = Appliance().ask(ControlOffset.REQUEST, line)
    assert result == 0
    assert json.loads(data[8:])["v"] == 1
