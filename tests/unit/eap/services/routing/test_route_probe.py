from __future__ import annotations

import asyncio

import pytest

from eap.ads.endpoint import Endpoint
from eap.ams.directory import AmsAddress
from eap.ams.routes import Route
from eap.errors import ControlError
from eap.ids import NetId
from eap.services.routing import tracing
from eap.services.routing.tracing import find_target, probe_target
from tests.support.ams import Ams
from tests.support.eventually import settle
from tests.support.routeviews import DIRECTORY, Left
from tests.support.routing import while_serving

BEYOND = Route(
    NetId.parse("127.0.9.3.1.1"), "third", Endpoint("udp:eap0", "127.0.9.2:34980"),
    router=NetId.parse("127.0.9.2.1.1"),
)  # fmt: skip
RIGHT = AmsAddress(NetId.parse("127.0.9.2.1.1"), 10000)


@pytest.mark.parametrize(
    ("text", "address"),
    [
        ("right", "127.0.9.2.1.1:10000"),
        ("left", "127.0.9.1.1.1:10000"),
        ("right/eap0", "127.0.9.2.2.1:65535"),
        ("9.9.9.9.1.1", "9.9.9.9.1.1:10000"),
        ("9.9.9.9.1.1:851", "9.9.9.9.1.1:851"),
    ],
)
def test_targets(text: str, address: str) -> None:
    assert str(find_target(Left().router, DIRECTORY, text)) == address


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("rihgt", "no station 'rihgt' in this plant, did you mean right.*nor is there a route"),
        ("1.2.3.4.5.600", "has a number above 255"),
    ],
)
def test_find_target_rejects_unknown_names(text: str, reason: str) -> None:
    with pytest.raises(ControlError, match=reason):
        find_target(Left().router, DIRECTORY, text)


def probe(
    target: AmsAddress, *, data: bytes | None = None, error: int = 0, down: str = "",
    more: Route | None = None,
):  # fmt: skip
    """Ask *target*; the hop answers with *data* or *error*, if with either."""
    left = Left()
    if more is not None:
        left.router.add_route(more)

    async def script():
        if down:
            left.router.hop_down("udp:eap0", None, down)
        task = asyncio.ensure_future(probe_target(left.router, target, 0.2))
        await settle()
        if data is not None:
            for endpoint, packet in list(left.sender.sent):
                answer: Ams = packet.answer(data, error)
                left.router.receive(answer.octets(), "udp:eap0", endpoint)
        return await task

    return asyncio.run(while_serving(script(), left.router))


def test_probe_reports_round_trip_and_state() -> None:
    found = probe(RIGHT, data=bytes.fromhex("00000000 0500 0000"))
    assert (found.ok, found.text, found.state, found.name) == (
        True, "answers: RUN", "RUN", "right"
    )  # fmt: skip
    assert 0 < found.rtt_us < 200_000
    assert (found.target, found.hint, found.error) == ("127.0.9.2.1.1:10000", "", 0)


@pytest.mark.parametrize(
    ("data", "text"),
    [("00000000 6300 0000", "answers: state 99"), ("01070000", "answers")],
)
def test_odd_answers_are_answers(data: str, text: str) -> None:
    found = probe(RIGHT, data=bytes.fromhex(data))
    assert (found.ok, found.text) == (True, text)


def test_probe_reports_errors_with_a_hint() -> None:
    found = probe(RIGHT, data=b"", error=7)
    assert (found.ok, found.rtt_us, found.error) == (False, None, 7)
    assert "knows no way to 127.0.9.2.1.1" in found.text
    assert "needs a route" in found.hint
    found = probe(RIGHT, down="no carrier")
    assert found.text == "right (127.0.9.2:34980 by udp:eap0) is down: no carrier"
    found = probe(AmsAddress(NetId.parse("9.9.9.9.1.1"), 10000))
    assert found.text == "there is no route to 9.9.9.9.1.1"
    assert "eapctl routes add" in found.hint


def test_request_beyond_a_dead_router_names_the_router() -> None:
    left = Left()
    left.router.add_route(BEYOND)
    target = AmsAddress(NetId.parse("127.0.9.3.1.1"), 10000)
    ask = probe_target(left.router, target, 0.2)
    left.router.hop_down("udp:eap0", "127.0.9.2:34980", "it does not answer")
    found = asyncio.run(while_serving(ask, left.router))
    text = "right (127.0.9.2:34980 by udp:eap0) is down: it does not answer"
    assert (found.name, found.text) == ("third", text)


def test_request_beyond_a_router_that_finds_a_fault_names_it(monkeypatch) -> None:
    async def find(router, *address):
        assert (router.name, str(AmsAddress(*address))) == ("left", "127.0.9.3.1.1:10000")
        return why

    monkeypatch.setattr(tracing, "find_fault", find)
    target = AmsAddress(NetId.parse("127.0.9.3.1.1"), 10000)
    why = "right: third (127.0.9.3:34980 by udp:eap1) is down: it does not answer"
    assert probe(target, data=b"", error=0x1B, more=BEYOND).text == why
    why = ""
    assert "the way is cut behind right" in probe(target, data=b"", error=0x1B, more=BEYOND).text
    assert probe(RIGHT, data=b"", error=0x1B).text.startswith("the way is cut behind right")


def test_probe_limits_the_time_of_the_fault_search(monkeypatch) -> None:
    async def find(router, *address):
        await asyncio.Event().wait()

    monkeypatch.setattr(tracing, "find_fault", find)
    monkeypatch.setattr(tracing, "FAULT_SEARCH_S", 0.01)
    target = AmsAddress(NetId.parse("127.0.9.3.1.1"), 10000)
    assert "no answer from right" in probe(target, more=BEYOND).text


def test_probe_reports_a_time_out() -> None:
    found = probe(RIGHT)
    assert found.error == 0x719
    assert "no answer from right" in found.text


def test_station_itself_answers_without_a_route() -> None:
    found = probe(AmsAddress(NetId.parse("127.0.9.1.1.1"), 10000))
    assert (found.ok, found.name, found.state) == (True, "", "RUN")
    found = probe(AmsAddress(NetId.parse("127.0.9.1.2.1"), 4))
    assert found.ok  # nothing has the port, and only the station can say so
