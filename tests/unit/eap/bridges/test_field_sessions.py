"""Clients and servers of both protocols against each other, without I/O."""

from collections.abc import Callable
from contextlib import suppress
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from eap.bridges.field.memory import ServedMemory, ServedPoint
from eap.bridges.field.plan import PointKey, ReadPlan, ReadSpan, batches, bytes_in
from eap.bridges.field.protocol import FieldLink, FieldLinkError, FieldSession
from eap.bridges.modbus.link import ModbusLink
from eap.bridges.modbus.session import ModbusSession
from eap.bridges.s7.link import S7Link
from eap.bridges.s7.session import S7Session
from eap.codec import datatypes
from eap.codec.fieldaddresses import FieldPoint, modbus_point, s7_point
from eap.codec.modbus import ModbusFrame
from eap.codec.s7 import (
    CotpConnect,
    CotpKind,
    PduKind,
    S7Function,
    S7Item,
    S7Pdu,
    data_item,
    decode_cotp,
    encode_data,
    encode_items,
)
from eap.config.bridge_sections import ModbusController, S7Controller
from eap.errors import CodecError

S7 = {
    "m/on": ("BOOL", "DB1.DBX0.0"), "m/speed": ("REAL", "DB1.DBD2"),
    "m/word": ("WORD", "DB2.DBW0"), "m/flag": ("BOOL", "M3.5"),
    "m/long": ("BLOCK(1200)", "DB3.DBB0"), "m/odd": ("BYTE", "DB2.DBB2"),
}  # fmt: skip
MODBUS = {
    "m/on": ("BOOL", "coil:3"), "m/speed": ("REAL", "holding:2"), "m/word": ("WORD", "input:0"),
    "m/flag": ("BOOL", "holding:1.5"), "m/long": ("BLOCK(600)", "holding:200"),
    "m/limit": ("BOOL", "discrete:0"),
}  # fmt: skip
VALUES = {
    "m/on": True, "m/speed": 1.5, "m/word": 0x1234, "m/flag": True, "m/odd": 7, "m/limit": True,
}  # fmt: skip


class Peer:
    """A link whose requests a session answers; *writes* are accepted unless there is a reason."""

    def __init__(self, link: FieldLink, session: FieldSession) -> None:
        self.link = link
        self.session = session
        self.writes: list[dict[str, Any]] = []
        self.reason = ""

    def reply(self, frame: bytes) -> bytes:
        assert self.session.frame_length(frame) == len(frame)
        answer = self.session.answer(frame)
        try:
            changes = next(answer)
            while True:
                self.writes.append(dict(changes))
                changes = answer.send(self.reason)
        except StopIteration as end:
            reply: bytes = end.value
            return reply

    def talk(self, conversation: Any) -> Any:
        try:
            frame = next(conversation)
            while True:
                frame = conversation.send(self.reply(frame))
        except StopIteration as end:
            return end.value


def memory_of(points: dict[str, FieldPoint]) -> ServedMemory:
    writable = {"m/on", "m/speed", "m/flag", "m/long"}
    memory = ServedMemory([ServedPoint(n, p, n in writable) for n, p in points.items()])
    for name, point in points.items():
        long = (bytes(range(200)) * 6)[: point.type.kind.size].hex()
        assert memory.update(name, VALUES.get(name, long)) == ""
    return memory


@pytest.fixture(params=["s7", "modbus"])
def both(request: pytest.FixtureRequest) -> tuple[Peer, dict[str, FieldPoint]]:
    if request.param == "s7":
        points = {n: s7_point(datatypes.parse(k), a) for n, (k, a) in S7.items()}
        peer = Peer(S7Link(S7Controller(host="a")), S7Session(memory_of(points)))
    else:
        points = {n: modbus_point(datatypes.parse(k), a) for n, (k, a) in MODBUS.items()}
        link = ModbusLink(ModbusController(host="a", unit=3))
        peer = Peer(link, ModbusSession(memory_of(points), 3))
    peer.talk(peer.link.open())
    return peer, points


def test_client_reads_what_the_server_shows(both: tuple[Peer, dict[str, FieldPoint]]) -> None:
    peer, points = both
    plan = ReadPlan({PointKey("m", name): p for name, p in points.items()}, peer.link.limits)
    found = {}
    for batch in batches(plan.spans, peer.link.fits):
        for span, data in zip(batch, peer.talk(peer.link.read(batch)), strict=True):
            assert isinstance(data, bytes), data
            for key in span.keys:
                point = plan.points[key]
                value = point.type.decode(bytes_in(span, data, point))
                found[key.variable] = point.type.kind.to_plain(value)
    long = found.pop("m/long")
    assert long == (bytes(range(200)) * 6)[: len(long) // 2].hex()
    assert found == {name: VALUES[name] for name in found}
    assert len(found) == len(points) - 1


@pytest.mark.parametrize(("name", "value"), [("m/on", False), ("m/speed", -2.5), ("m/flag", False)])
def test_client_writes_one_variable(
    both: tuple[Peer, dict[str, FieldPoint]], name: str, value: Any
) -> None:
    peer, points = both
    data = points[name].type.encode(value)
    assert peer.talk(peer.link.write(points[name], data)) == ""
    assert peer.writes == [{name: value}]
    peer.reason = "no rule allows it"
    assert peer.talk(peer.link.write(points[name], data)) != ""


def test_refused_values_have_their_reasons(both: tuple[Peer, dict[str, FieldPoint]]) -> None:
    peer, points = both
    kind = points["m/word"].type
    why = peer.talk(peer.link.write(points["m/word"], kind.encode(1)))
    # Input registers cannot be written at all, so the client's request is another one.
    assert why if points["m/word"].place.area != "input" else why == "illegal data address"
    assert peer.writes == []
    span = ReadSpan(points["m/speed"].place.area, 16 * 900, 32, ())
    (text,) = peer.talk(peer.link.read([span]))
    assert "address" in text


def test_s7_client_is_told_of_missing_blocks_beside_good_items() -> None:
    points = {"m/word": s7_point(datatypes.parse("WORD"), "DB2.DBW0")}
    peer = Peer(S7Link(S7Controller(host="a")), S7Session(memory_of(points)))
    peer.talk(peer.link.open())
    good, missing = ReadSpan("DB2", 0, 16, ()), ReadSpan("DB9", 0, 16, ())
    assert peer.talk(peer.link.read([missing, good])) == ["there is no such block", b"\x12\x34"]


def raw(peer: Peer, pdu: S7Pdu) -> S7Pdu:
    reply = decode_cotp(peer.reply(encode_data(pdu)))
    assert isinstance(reply, S7Pdu)
    return reply


def s7_peer() -> Peer:
    points = {n: s7_point(datatypes.parse(k), a) for n, (k, a) in S7.items()}
    peer = Peer(S7Link(S7Controller(host="a")), S7Session(memory_of(points)))
    peer.talk(peer.link.open())
    return peer


def test_every_item_of_a_write_is_stored_or_refused_for_itself() -> None:
    peer = s7_peer()
    items = [data_item(0x84, 1, 0, 1), data_item(0x84, 2, 0, 16), data_item(0x84, 1, 16, 32)]
    data = bytes.fromhex("00030001 00 0000040010 000100040020 40400000")
    reply = raw(peer, S7Pdu(PduKind.JOB, 9, encode_items(S7Function.WRITE, items), data))
    assert reply.data.hex() == "ff03ff"
    assert peer.writes == [{"m/on": False}, {"m/speed": 3.0}]


def test_s7_request_that_is_not_supported_has_an_error() -> None:
    peer = s7_peer()
    reply = raw(peer, S7Pdu(PduKind.JOB, 5, bytes.fromhex("28000000000000fd")))
    assert (reply.error, reply.reference) == (0x8104, 5)
    parameters = bytes.fromhex("0001120411440100")  # a system status list
    reply = raw(peer, S7Pdu(PduKind.USER_DATA, 6, parameters, bytes.fromhex("ff090004001c0000")))
    assert (reply.kind, reply.reference, reply.parameters[-2:].hex()) == (7, 6, "d401")
    assert reply.parameters[5] == 0x84


def test_s7_reply_longer_than_the_agreed_pdu_is_an_error() -> None:
    peer = s7_peer()
    items = [data_item(0x84, 3, 0, 8 * 600)] * 2
    assert raw(peer, S7Pdu(PduKind.JOB, 9, encode_items(S7Function.READ, items))).error == 0x8500


@pytest.mark.parametrize(
    ("item", "code"),
    [
        (S7Item(0, 0, 0, 0, 0), 0x06),
        (S7Item(0x84, 1, 3, 2, 1), 0x05),
        (S7Item(0x84, 1, 0, 1, 2), 0x06),
        (S7Item(0x1D, 0, 0, 0x1D, 1), 0x06),
        (S7Item(0x81, 0, 0, 2, 1), 0x0A),
    ],
    ids=["symbolic", "between bytes", "two bits", "timer", "inputs"],
)
def test_items_that_are_none_have_their_codes(item: S7Item, code: int) -> None:
    reply = raw(s7_peer(), S7Pdu(PduKind.JOB, 1, encode_items(S7Function.READ, [item])))
    assert reply.data[0] == code


def test_small_tpdus_limit_the_pdu() -> None:
    session = S7Session(ServedMemory([]))
    request = CotpConnect(CotpKind.REQUEST, 1, tpdu_size=512).encode()
    peer = Peer(S7Link(S7Controller(host="a")), session)
    confirm = decode_cotp(peer.reply(request))
    assert isinstance(confirm, CotpConnect)
    assert (confirm.kind, confirm.tpdu_size) == (CotpKind.CONFIRM, 512)
    setup = S7Pdu(PduKind.JOB, 1, bytes.fromhex("f000000800080fff"))
    assert raw(peer, setup).parameters.hex() == "f000000800080" + f"{509:03x}"


def test_modbus_session_answers_other_unit_with_no_path() -> None:
    session = ModbusSession(ServedMemory([]), 3)
    peer = Peer(ModbusLink(ModbusController(host="a")), session)
    request = ModbusFrame(1, 4, bytes.fromhex("0300000001"))
    assert ModbusFrame.decode(peer.reply(request.encode())).pdu.hex() == "830b"


def test_modbus_writes_before_it_reads_and_masks() -> None:
    points = {"m/word": modbus_point(datatypes.parse("WORD"), "holding:0")}
    memory = ServedMemory([ServedPoint("m/word", points["m/word"], write=True)])
    memory.update("m/word", 0x12)
    peer = Peer(ModbusLink(ModbusController(host="a")), ModbusSession(memory, 1))
    # The example of the specification: 0x12 AND 0xF2 OR 0x25 of the others is 0x17.
    peer.reply(ModbusFrame(1, 1, bytes.fromhex("16 0000 00f2 0025")).encode())
    assert peer.writes == [{"m/word": 0x17}]
    reply = peer.reply(ModbusFrame(1, 1, bytes.fromhex("17 0000 0001 0000 0001 02 0099")).encode())
    assert peer.writes[1:] == [{"m/word": 0x99}]
    assert ModbusFrame.decode(reply).pdu.hex() == "17020012"


def test_controller_that_refuses_the_connection_is_named() -> None:
    conversation = S7Link(S7Controller(host="a", rack=0, slot=9)).open()
    request = next(conversation)
    assert request[-4:].hex() == "c2020109"
    with pytest.raises(FieldLinkError, match="rack 0, slot 9"):
        conversation.send(bytes.fromhex("0300000b 06 80 0001 0001 00"))


@pytest.mark.parametrize(
    "make",
    [lambda: S7Session(ServedMemory([])), lambda: ModbusSession(ServedMemory([]), 1)],
    ids=["s7", "modbus"],
)
@given(data=st.binary(min_size=8, max_size=80))
def test_sessions_raise_nothing_but_codec_errors(
    make: Callable[[], FieldSession], data: bytes
) -> None:
    session = make()
    with suppress(CodecError):
        next(session.answer(data), None)
    head = b"\3\0" + (len(data) + 7).to_bytes(2, "big") + b"\2\xf0\x80"
    with suppress(CodecError):
        next(session.answer(head + b"\x32\1" + data), None)
