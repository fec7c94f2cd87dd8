from __future__ import annotations

import json

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from eap.codec.ethercat import EtherCatHeader
from eap.ops.decode import decode_frame
from tests.support.vectors import Vector, load, load_all

BROKEN = {"type5_gateway/ldr_resp3"}
GOOD = [v for v in load_all("ethernet", "frame") if not v.error]


def plain(frame: bytes) -> dict:
    """Return a decoded frame as ``--json`` prints it."""
    return json.loads(msgspec.json.encode(decode_frame(frame)))


def test_shape_of_the_contract() -> None:
    frame = bytes.fromhex("1540 c0a800010101 0100 0100 0000 e903 0000 0100 0000 01")
    assert plain(frame) == {
        "type": 4,
        "length": 21,
        "publisher": "192.168.0.1.1.1",
        "cycle": 1,
        "pds": [{"id": 0x03E9, "version": 0, "length": 1, "quality": 0, "data": "01"}],
        "error": None,
    }


@pytest.mark.parametrize("vector", GOOD, ids=lambda vector: vector.name)
def test_every_vector(vector: Vector) -> None:
    fields = plain(vector.frame)
    for name, expected in flat(vector.fields):
        if name[-1] not in ("count", "reserved", "eap_sm"):  # not part of the contract
            found = fields
            for key in name:
                found = found[key]
            if name[-2:] == ("mailbox", "type"):
                found = fields["mailbox"]["protocol"]
                found = {"error": "ERR"}.get(found, found.upper())
            assert found == expected, name
    if not vector.name.startswith("high_nibble"):
        assert fields["error"] is None


def flat(value: object, path: tuple = ()) -> list[tuple[tuple, object]]:
    if isinstance(value, dict):
        return [leaf for key, item in value.items() for leaf in flat(item, (*path, key))]
    if isinstance(value, list):
        return [leaf for at, item in enumerate(value) for leaf in flat(item, (*path, at))]
    return [(path, value)]


def test_logical_datagram_has_one_address() -> None:
    (datagram,) = decode_frame(bytes.fromhex("0c10 0c 01 78563412 0040 0000 0300")).datagrams
    assert (datagram.command, datagram.address) == ("LRW", 0x12345678)
    assert datagram.circulating is True
    assert "adp" not in msgspec.to_builtins(datagram)


def test_error_reply_names_its_reason() -> None:
    (vector,) = [v for v in load("type5_mailbox") if v.name.endswith("mbx_error")]
    message = decode_frame(vector.frame).mailbox
    assert (message.detail, message.reason) == (2, "UNSUPPORTED_PROTOCOL")


@pytest.mark.parametrize(
    ("octets", "error", "rest"),
    [
        ("", "EtherCatHeader at offset 0: needs 2 bytes", {"type": None, "length": None}),
        ("1540", "length 21, but 0 bytes follow", {"publisher": None, "cycle": None, "pds": []}),
        (
            "1540 c0a800010101 0100 0700 0000 e903",
            "length 21, but 14 bytes follow",
            {"publisher": "192.168.0.1.1.1", "cycle": 7, "pds": []},
        ),
        (
            "1540 c0a800010101 0100 0700 0000 e903 0000 0200 0000 01",
            "PD 1001 has 1 of 2 bytes",
            {"publisher": "192.168.0.1.1.1", "cycle": 7, "pds": []},
        ),
        ("0a40 c0a800010101 0100 0700 0000", "PdFrameHeader at offset 2", {"publisher": None}),
        ("0c10 0f 01 0000 0000 0000 0000 0000", "15 is not a valid Command", {"datagrams": []}),
        ("0650 0000 0000 00 06", "6 is not a valid MailboxType", {"mailbox": None}),
        ("0450 0000 0000", "MailboxHeader at offset 2: needs 6 bytes", {"mailbox": None}),
        ("0220 0000", "AmsHeader at offset 0: needs 32 bytes, but 2 follow", {"ams": None}),
        ("0570 00", "length 5, but 1 bytes follow", {"type": 7, "data": "00"}),
    ],
)
def test_fault_is_named_beside_what_could_be_read(octets: str, error: str, rest: dict) -> None:
    fields = plain(bytes.fromhex(octets))
    assert error in fields["error"]
    assert {name: fields[name] for name in rest} == rest


def test_good_pds_before_a_bad_one_are_shown() -> None:
    frame = bytes.fromhex(
        "1e40 c0a800010101 0200 0700 0000 0100 0000 0100 0000 aa 0200 0000 0900 0000 bb"
    )
    fields = decode_frame(frame)
    assert [pd.data for pd in fields.pds] == ["aa"]
    assert "PD 2 has 1 of 9 bytes" in fields.error


@pytest.mark.parametrize(
    ("octets", "service"),
    [("0850 0200 e903 00 13 0360", "TxPDO remote request 3"), ("0750 0100 e903 00 13 03", None)],
)
def test_coe_message_is_named(octets: str, service: str | None) -> None:
    assert plain(bytes.fromhex(octets))["mailbox"].get("service") == service


def test_bad_ams_leaves_the_mailbox_readable() -> None:
    fields = decode_frame(bytes.fromhex("0850 0200 e903 00 11 abcd"))
    assert fields.mailbox.protocol == "AoE"
    assert fields.mailbox.data == "abcd"
    assert "AmsHeader" in fields.error


def test_capture_cut_off_by_its_source() -> None:
    (vector,) = [v for v in load("type5_gateway") if v.name in BROKEN]
    fields = decode_frame(vector.frame)
    assert "length 256, but 14 bytes follow" in fields.error
    assert fields.mailbox.length == 0xFA


@given(st.binary(max_size=80), st.one_of(st.none(), st.integers(0, 15)))
def test_nothing_is_ever_raised(noise: bytes, frame_type: int | None) -> None:
    if frame_type is not None:
        noise = EtherCatHeader(len(noise), type=frame_type).encode() + noise
    assert {"type", "length", "error"} <= set(plain(noise))
