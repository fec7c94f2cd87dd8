"""tshark reads in our answers what we meant, and in AdsLib's requests what we read."""

from __future__ import annotations

import struct

import pytest

from eap.ads.notifications import AdsClient
from eap.codec.ams import AmsCommand, decode_packet, response_to
from eap.ids import Endpoint, NetId
from tests.support.adsdevice import DictStore, Station, variable_device
from tests.support.packets import ethernet
from tests.support.tshark import dissect, write_pcap
from tests.support.vectors import load

pytestmark = pytest.mark.tshark

CLIENT = AdsClient(Endpoint("tcp", "1"), NetId.parse("127.0.0.1.1.1"), 30000)


def frame(packet: bytes) -> bytes:
    """An AMS packet in a frame of type 2."""
    return ethernet(struct.pack("<H", 0x2000 | len(packet)) + packet)


def ams_fields(path, packets: list[bytes]) -> list[dict[str, str]]:
    """Fields of each packet by tshark's names, flat."""
    return [
        dict(flat(seen["layers"]["ams"])) for seen in dissect(write_pcap(path, map(frame, packets)))
    ]


def flat(layer):
    for name, value in layer.items():
        if isinstance(value, dict):
            yield from flat(value)
        elif isinstance(value, str):
            yield name.removeprefix("ams."), value


def number(text: str) -> int:
    return int(text, 0)


@pytest.fixture
def told(tmp_path):
    """By the name of the vector: what tshark sees in AdsLib's request and in our answer to it."""
    device, _ = variable_device(DictStore(), Station())
    vectors = load("ads_requests")
    answers, notices = [], []
    for vector in vectors:
        header, body = decode_packet(vector.octets)
        answer = device.answer(header.command, bytes(body), CLIENT, 0)
        answers.append(response_to(header, answer))
        for now_ns in (1, 10**9):
            told = device.notifications.handle_cycle(now_ns, 133_000_000_000_000_000)
            notices += [notice.encode(header.target, header.target_port) for notice in told]
    seen = ams_fields(tmp_path / "ads.pcap", [v.octets for v in vectors] + answers + notices)
    names = [vector.name.partition("/")[2] for vector in vectors]
    count = len(names)
    pairs = zip(names, zip(seen[:count], seen[count : 2 * count], strict=True), strict=True)
    return dict(pairs) | {"notice": (None, seen[2 * count])}


def test_every_answer_is_for_its_request(told) -> None:
    for name, (request, answer) in told.items():
        if name != "notice":
            assert answer["cmdid"] == request["cmdid"]
            assert answer["invokeid"] == request["invokeid"]
            assert (number(request["stateflags"]), number(answer["stateflags"])) == (4, 5)
            assert number(answer["errorcode"]) == 0
            assert "adsresult" in answer, name


def test_info_and_states(told) -> None:
    _, info = told["read_device_info"]
    assert (info["ads_versionversion"], info["ads_versionrevision"]) == ("3", "1")
    assert info["ads_versionbuild"] == "4024"
    assert info["ads_devicename"].rstrip("\0") == "island-01"
    _, states = told["read_state"]
    assert (number(states["ads_state"]), number(states["ads_devicestate"])) == (5, 8)


def test_wireshark_reads_values_of_ads_packets(told) -> None:
    request, answer = told["read"]
    assert number(request["ads_indexgroup"]) == 0x4040
    assert number(request["ads_indexoffset"]) == 16
    assert number(request["ads_cblength"]) == 4
    assert number(answer["ads_cblength"]) == 4
    assert number(answer["cbdata"]) == 12
    request, answer = told["symbol_info"]
    assert number(request["ads_cbreadlength"]) == 798
    assert number(request["ads_cbwritelength"]) == len("curve") + 1
    assert number(answer["ads_cblength"]) == number(answer["cbdata"]) - 8


def test_wireshark_reads_notifications(told) -> None:
    request, answer = told["add_notification"]
    assert number(request["ads_transmode"]) == 3
    assert number(request["ads_maxdelay"]) == 500_000
    assert number(request["ads_cycletime"]) == 200_000
    handle = number(answer["ads_notificationhandle"])
    assert number(told["delete_notification"][0]["ads_notificationhandle"]) == handle
    _, notice = told["notice"]
    assert number(notice["cmdid"]) == AmsCommand.NOTIFICATION
    assert number(notice["stateflags"]) == 4
    assert number(notice["ads_noteblocksstamps"]) == 1
