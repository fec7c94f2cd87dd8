from __future__ import annotations

import pytest

from eap.ads.endpoint import Endpoint
from eap.ams.report import (
    MAX_REPORT,
    HopQuestion,
    HopReport,
    decode_report,
    encode_report,
    report_of,
)
from eap.ams.spec import AccessRule, ObjectRange
from eap.ams.spec import AccessService as Service
from eap.codec.ams import AmsHeader
from eap.errors import CodecError
from eap.ids import NetId
from tests.support.aoerouter import FAR, LINK, ROUTER, Station, route

LAPTOP = Endpoint("tcp", "10.0.0.5:49152")
SOURCE = NetId.parse("192.168.0.9.1.1")


def ask(station: Station, net_id: str, port: int, endpoint: Endpoint = LAPTOP) -> HopReport:
    target = NetId.parse(net_id)
    location = station.router.locate(AmsHeader(target, port, SOURCE, 1, 4), endpoint)
    return report_of("island", NetId.parse(ROUTER), target, location, station.now_ns)


def test_question_on_the_wire() -> None:
    question = HopQuestion(NetId.parse(FAR), 1001, 2)
    assert question.encode() == bytes.fromhex("060101010101 e903 02 00")


def test_what_is_here() -> None:
    here = ask(Station(rules=()), "5.1.1.1.2.1", 0xFFFF)
    assert (here.station, here.net_id, here.is_here, here.why) == ("island", ROUTER, True, "")
    assert here.may[Service.READ] is True
    assert here.may[Service.WRITE] is False
    missing = ask(Station(), "5.1.1.1.2.1", 7)
    assert missing.why == "nothing has port 7 of 5.1.1.1.2.1"


def test_what_is_behind_a_route() -> None:
    objects = AccessRule("objects", objects=(ObjectRange(0x8000, 0x8000),))
    near = NetId.parse("6.2.2.2.1.1")
    far = route("10.6.6.6.1.1", LINK, "far", router=near, real=NetId.parse(FAR))
    onward = ask(Station([far], rules=(objects,)), "10.6.6.6.3.1", 1001)
    assert (onward.is_here, onward.route, onward.next_net_id) == (False, "far", str(near))
    assert (onward.transport, onward.address, onward.state, onward.why) == (*LINK, "unknown", "")
    assert onward.target == "6.1.1.1.3.1"
    assert onward.may[Service.WRITE] is None


def test_why_nothing_goes_there() -> None:
    station = Station([route(FAR, LINK, "far")])
    assert ask(station, "9.9.9.9.1.1", 1).why == "no route to 9.9.9.9.1.1"
    back = ask(station, FAR, 1, LINK)
    assert (back.route, back.why) == ("far", "route far leads back to where it came from")
    station.router.hop_down(*LINK, "cable pulled", 1)
    down = ask(station, FAR, 1)
    assert (down.state, down.why) == ("down", "far (10.0.0.6 by link) is down: cable pulled")


def test_reports_survive_the_wire() -> None:
    report = ask(Station([route(FAR, LINK, "far")]), FAR, 1)
    data = encode_report(report)
    assert len(data) < MAX_REPORT
    assert decode_report(data) == report


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"\xff",
        b"[]",
        b'{"station": "x", "net_id": "1.2"}',
        b'{"station": 5}',
        b'{"station": "\\u001b[2J", "net_id": "1.2.3.4.5.6"}',
    ],
)
def test_what_is_no_report(data: bytes) -> None:
    with pytest.raises(CodecError):
        decode_report(data)
