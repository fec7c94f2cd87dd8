"""Control protocol by ADS: rates, parts of answers, and rules of other stations."""

from __future__ import annotations

import asyncio
import json
import random
import struct
from contextlib import suppress
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from eap.ads.request import ReadWrite, decode_outcome, encode_query
from eap.ams.access import AccessList
from eap.ams.spec import AccessRule, AccessService
from eap.codec.ads import AdsError, IndexGroup
from eap.codec.ams import CONTROL_PORT, AmsAnswer, AmsHeader
from eap.control.by_ads import CONFIGURE_METHODS, KEPT_S, MAX_PACKED, ControlOffset, pack, unpack
from eap.control.device import ApplyAnswer
from eap.control.protocol import MAX_LINE
from eap.errors import ControlError
from eap.ids import Endpoint, NetId
from eap.services.control.control_ads import (
    AT_ONCE_S,
    KEPT_BYTES,
    RATES,
    STATUS_S,
    ControlAds,
    RemoteControl,
)
from eap.services.routing.service import LocalRequest
from eap.services.routing.station_router import StationRouter
from tests.support.virtualtime import run_virtual

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
        self.audit: list[tuple[str, str, dict[str, Any]]] = []
        self.slow = asyncio.Event()
        self.slow.set()
        self.control = RemoteControl(
            self._call, self.routers, lambda: self.now_s, lambda *line: self.audit.append(line)
        )
        self.service = ControlAds("near", self.control)

    async def _call(self, method: str, params: dict[str, Any]) -> Any:
        self.calls.append(method)
        if method == "status":
            stations = [{"name": name} for name in STATIONS]
            wheres = ["near/eap0", "far", "far/eap0", "far ← pd", "farther"]
            return {"stations": stations, "findings": [{"where": each} for each in wheres]}
        if method in CONFIGURE_METHODS:
            await self.slow.wait()
        if isinstance(self.values, Exception):
            raise self.values
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
        group: int = IndexGroup.CONTROL,
    ) -> tuple[int, bytes]:
        """Return result and data of the answer to a request from a host."""
        return asyncio.run(self.ask_soon(offset, data, length, host=host, port=port, group=group))

    async def ask_soon(
        self,
        offset: int,
        data: bytes,
        length: int = 60_000,
        *,
        host: str = "10.0.0.9",
        port: int = 1,
        group: int = IndexGroup.CONTROL,
    ) -> tuple[int, bytes]:
        """Return result and data of the answer to a request from a host."""
        command, body = encode_query(ReadWrite(group, offset, length, data))
        source = NetId.parse("10.0.0.9.1.1")
        header = AmsHeader(NEAR, CONTROL_PORT, source, port, command)
        endpoint = Endpoint("ams-tcp", f"{host}:4000#1")
        answer = self.service.answer(LocalRequest(header, body, endpoint))
        found = answer if isinstance(answer, AmsAnswer) else await answer
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


def packed(method: str, **params: Any) -> bytes:
    return pack(json.dumps({"v": 1, "id": 4, "method": method, "params": params}).encode())


def configure(appliance: Appliance, method: str, **params: Any) -> dict[str, Any]:
    """Return the answer to a request of the group CONFIGURE that has one part."""
    offset = CONFIGURE_METHODS[method]
    data = packed(method, **params)
    result, answer = appliance.ask(offset, data, group=IndexGroup.CONFIGURE)
    assert (result, answer[:4]) == (0, bytes(4))
    document: dict[str, Any] = json.loads(answer[8:])
    return document


def test_change_is_made_and_its_outcome_is_in_the_audit() -> None:
    appliance = Appliance()
    appliance.values = ApplyAnswer(ok=False, results=[], station=[], refused=["disk full"])
    answer = configure(appliance, "apply", station="near", spec={"name": "near"}, cause="7")
    assert answer["result"]["refused"] == ["disk full"]
    fields = {"operation": "apply", "asked": {"cause": "7"}, "error": "disk full"}
    assert appliance.audit == [("ams-tcp 10.0.0.9, 10.0.0.9.1.1", "near", fields)]


def test_change_that_fails_is_an_answer_and_in_the_audit() -> None:
    appliance = Appliance()
    appliance.values = ControlError("no engine", code="unavailable")
    answer = configure(appliance, "rollback", station="near")
    assert answer["error"] == {"code": "unavailable", "message": "no engine"}
    assert [line[2]["error"] for line in appliance.audit] == ["no engine"]


def test_plan_and_export_are_not_audited() -> None:
    appliance = Appliance()
    for method in ("plan", "export", "routing_plan", "routing_export"):
        configure(appliance, method, station="near")
    assert appliance.audit == []


def test_rules_of_another_station_decide_on_its_configuration() -> None:
    appliance = Appliance()  # other hosts only read where no rule says more
    refused = configure(appliance, "apply", station="far")["error"]
    assert (refused["code"], appliance.calls) == ("refused", [])
    assert "station far: " in refused["message"]
    rule = AccessRule(name="engineers", allow=True, services=(AccessService.CONFIGURE,))
    permitted = Appliance(far=rule)
    assert configure(permitted, "apply", station="far")["result"] == {}


@pytest.mark.parametrize(
    ("offset", "data", "reason"),
    [
        (CONFIGURE_METHODS["plan"], packed("apply", station="near"), "is no method of offset 1"),
        (CONFIGURE_METHODS["plan"], packed("stop"), "'stop' is no method of offset 1"),
        (99, packed("apply", station="near"), "'apply' is no method of offset 99"),
        (CONFIGURE_METHODS["plan"], b"{}", "not compressed: "),
        (CONFIGURE_METHODS["plan"], packed("plan")[:-3], "a request has at most "),
        (CONFIGURE_METHODS["plan"], pack(bytes(MAX_LINE + 1)), "a request has at most "),
    ],
)
def test_request_that_is_none_about_a_configuration_is_refused(
    offset: int, data: bytes, reason: str
) -> None:
    appliance = Appliance()
    result, answer = appliance.ask(offset, data, group=IndexGroup.CONFIGURE)
    assert result == 0
    assert reason in json.loads(answer[8:])["error"]["message"]
    assert appliance.calls == []


def test_request_that_cannot_be_packed_is_an_error() -> None:
    with pytest.raises(ControlError, match=f"has at most {MAX_PACKED} bytes, not "):
        pack(random.Random(1).randbytes(MAX_PACKED + 100))


@given(st.binary(max_size=300))
def test_any_line_is_packed_and_unpacked(line: bytes) -> None:
    assert unpack(pack(line)) == line


@given(st.binary(max_size=300))
def test_any_data_is_unpacked_or_refused(data: bytes) -> None:
    with suppress(ControlError):
        assert len(unpack(data)) <= MAX_LINE


def test_answer_that_takes_long_is_fetched_by_its_ticket() -> None:
    appliance = Appliance()

    async def run() -> None:
        appliance.slow.clear()
        data = packed("apply", station="near")
        offset = CONFIGURE_METHODS["apply"]
        result, answer = await appliance.ask_soon(offset, data, group=IndexGroup.CONFIGURE)
        ticket, total = struct.unpack("<II", answer)
        assert (result, total) == (0, 0)
        assert ticket
        wanted = struct.pack("<II", ticket, 0)
        # Not there yet, and never for another client.
        assert await appliance.ask_soon(ControlOffset.PART, wanted) == (0, answer)
        other, _ = await appliance.ask_soon(ControlOffset.PART, wanted, port=2)
        assert other == AdsError.NOT_FOUND
        appliance.slow.set()
        await asyncio.sleep(AT_ONCE_S)
        found = await appliance.ask_soon(ControlOffset.PART, wanted)
        assert json.loads(found[1][8:])["result"] == {}
        assert [line[1] for line in appliance.audit] == ["near"]

    run_virtual(run())
