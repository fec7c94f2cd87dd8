"""Topics, payloads, infos and client ports of AMS over MQTT."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from eap.ams.mqtt.messages import (
    FIRST_PORT,
    LAST_PORT,
    MAX_INFO,
    MAX_NAME,
    ClientPorts,
    Info,
    Payload,
    TopicKind,
    Topics,
    check_network,
    decode_info,
    decode_payload,
    encode_info,
    encode_payload,
)
from eap.errors import MalformedError, TruncatedError
from eap.ids import NetId
from tests.support.ams import NOTIFICATION, Ams, parse

OWN, OTHER = NetId.parse("5.1.1.1.1.1"), NetId.parse("6.1.1.1.1.1")
TOPICS = Topics("hall/line-1", OWN)


def test_topics_are_those_of_the_documentation() -> None:
    assert TOPICS.info == "hall/line-1/5.1.1.1.1.1/info"
    assert TOPICS.filters == ("hall/line-1/5.1.1.1.1.1/ams/#", "hall/line-1/+/info")
    assert TOPICS.of("6.1.1.1.1.1", TopicKind.REQUESTS) == "hall/line-1/6.1.1.1.1.1/ams"
    assert TOPICS.of("6.1.1.1.1.1", TopicKind.ANSWERS) == "hall/line-1/6.1.1.1.1.1/ams/res"


@pytest.mark.parametrize("kind", TopicKind)
def test_topic_is_read_as_it_was_written(kind: TopicKind) -> None:
    assert TOPICS.parse(TOPICS.of(str(OTHER), kind)) == (OTHER, kind)


@pytest.mark.parametrize(
    "topic",
    [
        "hall/line-2/5.1.1.1.1.1/info",
        "hall/line-1",
        "hall/line-1/5.1.1.1.1/info",
        "hall/line-1/05.1.1.1.1.1/info",
        "hall/line-1/5.1.1.1.1.1",
        "hall/line-1/5.1.1.1.1.1/",
        "hall/line-1/5.1.1.1.1.1/ams/res/x",
        "hall/line-1/5.1.1.1.1.1/INFO",
        "hall/line-1/5.1.1.1.1.999/info",
    ],
)
def test_other_topics_mean_nothing(topic: str) -> None:
    assert TOPICS.parse(topic) is None


@given(st.text())
def test_no_topic_raises(text: str) -> None:
    TOPICS.parse(text)
    TOPICS.parse(f"hall/line-1/{text}")


@pytest.mark.parametrize(
    "name", ["", "a+b", "a#", "$SYS", "/a", "a/", "a\0", "a\n", "x" * 129], ids=repr
)
def test_name_that_no_network_can_have_is_refused(name: str) -> None:
    with pytest.raises(ValueError, match="is no name of a network"):
        check_network(name)
    with pytest.raises(ValueError, match="is no name of a network"):
        Topics(name, OWN)


PACKET = Ams("5.1.1.1.1.1:10000", "6.1.1.1.1.1:33000", body=b"asked").octets()
PREFIX = bytes.fromhex("0000 25000000")


def test_both_forms_are_recognised() -> None:
    assert decode_payload(PACKET) == Payload(PACKET, is_prefixed=False)
    assert decode_payload(PREFIX + PACKET) == Payload(PACKET, is_prefixed=True)


@pytest.mark.parametrize("is_prefixed", [False, True])
def test_packet_is_sent_in_the_form_it_should_have(is_prefixed: bool) -> None:
    sent = encode_payload(Payload(PACKET, is_prefixed))
    assert sent == (PREFIX if is_prefixed else b"") + PACKET
    assert decode_payload(sent) == Payload(PACKET, is_prefixed)


@pytest.mark.parametrize("front", [b"\1\0\x25\0\0\0", b"\0\0\x24\0\0\0"])
def test_anything_else_in_front_belongs_to_the_packet(front: bytes) -> None:
    assert decode_payload(front + PACKET) == Payload(front + PACKET, is_prefixed=False)


@given(st.binary(max_size=31))
def test_payload_without_header_is_truncated(payload: bytes) -> None:
    with pytest.raises(TruncatedError):
        decode_payload(payload)


DOCUMENTED = (
    b'<info>\n  <online name="EC2AMAZ-2RRSQS6" osVersion="10.0.20348" osPlatform="2"'
    b' tcVersion="3.1.4026.10">true</online>\n</info>'
)
"""As the vendor's documentation of ADS-over-MQTT shows it."""
LAUGHS = (
    b'<!DOCTYPE info [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;&a;">]>'
    b'<info><online name="&b;">true</online></info>'
)


def test_documented_message_is_read() -> None:
    assert decode_info(DOCUMENTED) == Info("EC2AMAZ-2RRSQS6", is_online=True)
    assert decode_info(DOCUMENTED.replace(b"true", b"false")) == Info("EC2AMAZ-2RRSQS6", False)


def test_message_is_written_in_the_documented_form() -> None:
    written = encode_info(Info("island-01", is_online=True))
    assert written == b'<info><online name="island-01" osPlatform="4">true</online></info>'
    assert b">false</online>" in encode_info(Info("island-01", is_online=False))


@given(st.text(st.characters(exclude_categories=("C", "Z")), max_size=MAX_NAME), st.booleans(),
       st.booleans())  # fmt: skip
def test_message_is_read_as_it_was_written(name: str, is_online: bool, is_one_way: bool) -> None:
    info = Info(name, is_online, is_one_way)
    assert decode_info(encode_info(info)) == info


def test_no_octets_and_a_nul_behind_are_understood() -> None:
    assert decode_info(b"") == Info("", is_online=False)
    assert decode_info(b"<info><online> TRUE </online></info>\0") == Info("", is_online=True)


def test_info_name_is_printable_and_limited() -> None:
    told = decode_info(
        f'<info><online name=" a&#8238;&#10;[2J{"b" * 99}">true</online></info>'.encode()
    )
    assert told.name == ("a[2J" + "b" * 99)[:MAX_NAME]


@pytest.mark.parametrize(
    ("payload", "text"),
    [
        (b"true", "not XML that is read"),
        (b"<info><online>true</online>", "not XML that is read"),
        (LAUGHS, "not XML that is read"),
        (b'<!DOCTYPE info SYSTEM "file:///etc/passwd"><info/>', "not XML that is read"),
        (b'<?xml version="1.0" encoding="nonsense"?><info/>', "not XML that is read"),
        (b'<?xml version="1.0" encoding="utf-7"?><info/>', "not XML that is read"),
        (b"<info/>", "online is ''"),
        (b"<info><online>perhaps</online></info>", "online is 'perhaps'"),
        (b"<html/>", "begins with 'html'"),
        (b"<info>" + b" " * MAX_INFO + b"</info>", f"at most {MAX_INFO}"),
        (b"<a>" * (MAX_INFO // 3), "not XML that is read"),
    ],
)
def test_other_messages_are_named(payload: bytes, text: str) -> None:
    with pytest.raises(MalformedError, match=text):
        decode_info(payload)


@given(st.binary())
def test_any_octets_are_read_or_refused(payload: bytes) -> None:
    try:
        decode_info(payload)
    except MalformedError:
        return


OWN_PORTS = "5.1.1.1.1.1"
TARGET = "6.1.1.1.2.1:1001"
TOOL, SECOND = "192.168.0.9.1.1:33000", "192.168.0.9.1.1:33001"


def asked_by(ports: ClientPorts, source: str) -> str:
    """Return the source that others see of a request of *source*."""
    out = parse(ports.to_network(Ams(TARGET, source, invoke_id=7, body=b"what").octets()))
    assert (out.target, out.invoke_id, out.body) == (TARGET, 7, b"what")
    return out.source


def test_client_ports_translate_requests_and_answers() -> None:
    ports = ClientPorts(NetId.parse(OWN_PORTS))
    asked = Ams(TARGET, TOOL, invoke_id=7, body=b"what")
    out = parse(ports.to_network(asked.octets()))
    assert out == asked._replace(source=f"{OWN_PORTS}:{FIRST_PORT}")
    assert parse(ports.to_client(out.answer().octets())) == asked.answer()
    note = Ams(out.source, TARGET, command=NOTIFICATION, body=b"news")
    assert parse(ports.to_client(note.octets())) == note._replace(target=TOOL)


def test_each_client_has_a_port_and_keeps_it() -> None:
    ports = ClientPorts(NetId.parse(OWN_PORTS))
    assert [asked_by(ports, each) for each in (TOOL, SECOND, TOOL)] == [
        f"{OWN_PORTS}:{FIRST_PORT}", f"{OWN_PORTS}:{FIRST_PORT + 1}", f"{OWN_PORTS}:{FIRST_PORT}",
    ]  # fmt: skip
    assert len(ports) == 2


def test_programs_of_the_router_itself_keep_their_ports_unless_given_out() -> None:
    ports = ClientPorts(NetId.parse(OWN_PORTS))
    assert asked_by(ports, f"{OWN_PORTS}:30000") == f"{OWN_PORTS}:30000"
    assert asked_by(ports, f"{OWN_PORTS}:{FIRST_PORT + 9}") == f"{OWN_PORTS}:{FIRST_PORT}"


def test_answers_and_notifications_of_this_station_go_out_as_they_are() -> None:
    ports = ClientPorts(NetId.parse(OWN_PORTS))
    answer = Ams(TARGET, "6.1.1.1.1.1:33000").answer().octets()
    note = Ams(TARGET, "5.1.1.1.2.1:65535", command=NOTIFICATION).octets()
    assert (ports.to_network(answer), ports.to_network(note)) == (answer, note)


def test_requests_and_unknown_ports_are_not_translated() -> None:
    ports = ClientPorts(NetId.parse(OWN_PORTS))
    source = asked_by(ports, TOOL)
    request = Ams(source, TARGET).octets()
    assert ports.to_client(request) == request
    for target in (
        f"{OWN_PORTS}:{FIRST_PORT + 1}",
        f"{OWN_PORTS}:30000",
        f"5.1.1.1.2.1:{FIRST_PORT}",
    ):
        answer = Ams(TARGET, target).answer().octets()
        assert ports.to_client(answer) == answer


def test_port_of_client_silent_for_longest_is_reused() -> None:
    ports = ClientPorts(NetId.parse(OWN_PORTS))
    first, second = asked_by(ports, TOOL), asked_by(ports, SECOND)
    for number in range(LAST_PORT - FIRST_PORT - 1):
        asked_by(ports, f"7.1.1.1.{number >> 8}.1:{number & 0xFF}")
    ports.to_client(Ams(TARGET, first).answer().octets())
    assert asked_by(ports, "8.1.1.1.1.1:1") == second
    assert asked_by(ports, TOOL) == first
    assert asked_by(ports, SECOND) == f"{OWN_PORTS}:{FIRST_PORT + 2}"
    assert len(ports) == LAST_PORT - FIRST_PORT + 1
