from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from eap.ams.mqtt.messages import Payload, decode_payload, encode_payload
from eap.errors import TruncatedError
from tests.support.ams import Ams

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
def test_what_has_not_even_a_header_is_refused(payload: bytes) -> None:
    with pytest.raises(TruncatedError):
        decode_payload(payload)
