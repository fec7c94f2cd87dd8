from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from eap.ams.mqtt.messages import MAX_INFO, MAX_NAME, Info, decode_info, encode_info
from eap.errors import MalformedError

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


def test_name_is_what_people_can_read() -> None:
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
