from __future__ import annotations

from ipaddress import IPv4Address

import pytest
from hypothesis import given
from hypothesis import strategies as st

from eap.codec.arp import NO_MAC, REPLY, REQUEST, SIZE, ArpMessage
from eap.errors import CodecError, MalformedError, TruncatedError
from eap.ids import BROADCAST_MAC, MacAddr

OURS = MacAddr.parse("02:00:00:00:00:01")
THEIRS = MacAddr.parse("02:00:00:00:00:02")
ADDRESS = IPv4Address("10.1.2.3")
OTHER = IPv4Address("10.1.2.4")
# RFC 826: hardware 1, protocol 0x0800, sizes 6 and 4, operation, both addresses of both hosts.
PROBE = "0001080006040001 020000000001 00000000 000000000000 0a010203"
ANSWER = "0001080006040002 020000000002 0a010203 020000000001 00000000"

macs = st.binary(min_size=6, max_size=6).map(MacAddr)
addresses = st.ip_addresses(v=4)


def test_probe_has_no_sender_address() -> None:
    assert ArpMessage.probe(OURS, ADDRESS).encode() == bytes.fromhex(PROBE)
    assert ArpMessage.decode(bytes.fromhex(PROBE)).is_probe


def test_answer_to_probe_shows_owner_of_address() -> None:
    message = ArpMessage.decode(bytes.fromhex(ANSWER))
    assert message == (REPLY, THEIRS, ADDRESS, OURS, IPv4Address(0))
    assert message.shows_sender
    assert not message.is_probe


@given(st.integers(0, 0xFFFF), macs, addresses, macs, addresses, st.integers(0, 20))
def test_arp_packet_survives_its_bytes(
    operation, sender_mac, sender, target_mac, target, padding
) -> None:
    message = ArpMessage(operation, sender_mac, sender, target_mac, target)
    data = bytes(padding) + message.encode() + bytes(18)
    assert ArpMessage.decode(data, padding) == message


@given(st.integers(0, SIZE - 1))
def test_every_prefix_is_truncated(size: int) -> None:
    with pytest.raises(TruncatedError):
        ArpMessage.decode(bytes.fromhex(PROBE)[:size])


@given(st.binary(max_size=60))
def test_garbage_decodes_or_raises_codec_error(noise: bytes) -> None:
    try:
        message = ArpMessage.decode(noise)
    except CodecError:
        return
    assert message.encode()[2:] == noise[2:SIZE]  # hardware 6 is read as 1


@pytest.mark.parametrize("head", ["0002080006040001", "0001080106040001", "0001080008040001"])
def test_other_kinds_of_addresses_are_malformed(head: str) -> None:
    with pytest.raises(MalformedError, match="expected 1, 0x0800"):
        ArpMessage.decode(bytes.fromhex(head + PROBE[16:]))


@pytest.mark.parametrize(
    ("message", "shows"),
    [
        (ArpMessage(REPLY, THEIRS, ADDRESS, OURS, OTHER), True),
        (ArpMessage(REQUEST, THEIRS, ADDRESS, NO_MAC, OTHER), True),
        (ArpMessage(REQUEST, THEIRS, ADDRESS, NO_MAC, ADDRESS), True),  # an announcement
        (ArpMessage.probe(THEIRS, ADDRESS), False),
        (ArpMessage(REPLY, BROADCAST_MAC, ADDRESS, OURS, OTHER), False),
        (ArpMessage(REPLY, NO_MAC, ADDRESS, OURS, OTHER), False),
        (ArpMessage(3, THEIRS, ADDRESS, OURS, OTHER), False),  # RARP
    ],
)
def test_request_for_owner_of_address(message: ArpMessage, shows: bool) -> None:
    assert message.shows_sender is shows
