"""The high-nibble dialect, by the requests that its published clients send."""

from __future__ import annotations

from contextlib import suppress

import pytest

from eap.codec.mailbox import MailboxHeader, MailboxType, decode_frame, encode_frame
from eap.codec.soe import Element
from eap.errors import CodecError, MalformedError
from eap.gateway import dialect
from eap.gateway.dialect import (
    DialectFailure,
    ExchangeVoe,
    ReadFile,
    ReadIdn,
    ReadSdo,
    WriteIdn,
    WriteSdo,
)
from tests.support.vectors import load

COE, FOE, SOE, VOE = (MailboxType[name] for name in ("COE", "FOE", "SOE", "VOE"))
VENDOR = ReadSdo(0x1018, 1, complete=False)
TASKS = {
    "coe_read_master_0x1018_01": (0, ReadSdo(0x1018, 1, complete=False)),
    "coe_read_slave_0x03e9_0x6040_00": (1001, ReadSdo(0x6040, 0, complete=False)),
    "coe_write_slave_0x03e9_0x6040_00_06_00": (1001, WriteSdo(0x6040, 0, b"\6\0")),
    "soe_read_idn_32_drive0_element_5_value": (1001, ReadIdn(32, 0, Element.VALUE)),
    "soe_read_idn_32_drive1_element_0_name": (1001, ReadIdn(32, 1, Element.NAME)),
    "soe_write_idn_32_1000": (1001, WriteIdn(32, 0, Element.VALUE, bytes.fromhex("e8030000"))),
    "foe_read_firmware_bin": (1001, ReadFile("firmware.bin")),
    "voe_vendor_0x1164_type_1_data_01_02": (1001, ExchangeVoe(bytes.fromhex("6411000001000102"))),
}
VECTORS = {vector.name.partition("/")[2]: vector for vector in load("high_nibble_dialect")}


def test_every_vector_has_its_task() -> None:
    assert set(VECTORS) == set(TASKS)


@pytest.mark.parametrize("name", TASKS)
def test_requests_that_are_seen_on_the_wire(name) -> None:
    address, task = TASKS[name]
    header, body = decode_frame(VECTORS[name].frame)
    kind = dialect.kind_of(header)
    assert kind is not None
    assert header.address == address
    assert dialect.decode(kind, bytes(body)) == task


def test_the_standard_is_no_dialect() -> None:
    frames = [vector.frame for vector in load("type5_gateway") if vector.layer == "frame"]
    assert frames
    for frame in frames:
        with suppress(CodecError):  # some are cut short
            assert dialect.kind_of(decode_frame(frame)[0]) is None
    assert dialect.kind_of(MailboxHeader(0, counter=1)) is None
    assert dialect.kind_of(MailboxHeader(0)) is None


@pytest.mark.parametrize("kind", [COE, SOE, FOE, VOE])
def test_answers_have_the_type_where_requests_have_it(kind) -> None:
    frame = encode_frame(dialect.encode_header(kind, 1001), b"")
    assert frame[7] == {COE: 0x30, SOE: 0x40, FOE: 0x50, VOE: 0xF0}[kind]
    header, _ = decode_frame(frame)
    assert dialect.kind_of(header) is kind


@pytest.mark.parametrize(
    ("kind", "octets", "task"),
    [
        (COE, "0020 50 1810 00", ReadSdo(0x1018, 0, complete=True)),
        (COE, "0020 20 1810 00 010203040506", WriteSdo(0x1018, 0, b"\1\2\3\4\5\6")),
        (COE, "0020 2b 1810 00 01020000", WriteSdo(0x1018, 0, b"\1\2")),
        (COE, "0020 21 1810 00 05000000 0102030405", WriteSdo(0x1018, 0, b"\1\2\3\4\5")),
        (SOE, "01 3f 2000", ReadIdn(32, 7, Element.ATTRIBUTE)),
        (SOE, "02 06 2000 0500", WriteIdn(32, 0, Element.DEFAULT, b"\5\0")),
        (FOE, "01 00000000", ReadFile("")),
    ],
)
def test_dialect_decodes_variants_of_requests(kind, octets, task) -> None:
    assert dialect.decode(kind, bytes.fromhex(octets)) == task


@pytest.mark.parametrize(
    ("kind", "octets", "why"),
    [
        (COE, "0020 40 1810", "CoE request of 5 bytes, expected at least 6"),
        (COE, "0030 40 1810 00", "CoE service 3, expected 2"),
        (COE, "0020 60 1810 00", "SDO command 0x60"),
        (COE, "0020 20 1810 00", "a download without data"),
        (SOE, "01 05 20", "SoE request of 3 bytes"),
        (SOE, "03 05 2000", "SoE command 3, expected 1 or 2"),
        (SOE, "01 45 2000", "drive 8, expected 0 to 7"),
        (FOE, "01 0000", "FoE request of 3 bytes"),
        (FOE, "02 00000000 66", "FoE opcode 2: only whole files are read"),
        (VOE, "641100000100"[:-2], "VoE request of 5 bytes"),
        (COE, "0020 23 0020 00", "6 bytes, expected at least 10"),
    ],
)
def test_dialect_malformed_request_error_names_the_expectation(kind, octets, why) -> None:
    with pytest.raises(MalformedError, match=why):
        dialect.decode(kind, bytes.fromhex(octets))


@pytest.mark.parametrize(
    ("request_", "task", "data", "answer"),
    [
        (
            "0020 40 1810 01",
            ReadSdo(0x1018, 1, complete=False),
            "02000000",
            "0030 43 1810 01 02000000",
        ),
        ("0020 40 1810 01", ReadSdo(0x1018, 1, complete=False), "02", "0030 4f 1810 01 02000000"),
        (
            "0020 40 0810 00",
            ReadSdo(0x1008, 0, complete=False),
            "6162636465",
            "0030 41 0810 00 05000000 6162636465",
        ),
        ("0020 20 4060 00 0600", WriteSdo(0x6040, 0, b"\6\0"), "", "0030 60 4060 00 00000000"),
        ("01 05 2000", ReadIdn(32, 0, Element.VALUE), "e8030000", "02 05 2000 e8030000"),
        ("02 05 2000 e8030000", WriteIdn(32, 0, Element.VALUE, b""), "", "04 05 2000"),
        ("01 00000000 66", ReadFile("f"), "0102", "03 00000000 0102"),
        ("64110000 0100 01", ExchangeVoe(b""), "64110000 0100 02", "64110000 0100 02"),
    ],
)
def test_dialect_encodes_replies(request_, task, data, answer) -> None:
    body = dialect.encode_done(bytes.fromhex(request_), task, bytes.fromhex(data))
    assert body == bytes.fromhex(answer)


@pytest.mark.parametrize(
    ("kind", "octets", "failure", "answer"),
    [
        (COE, "0020 40 1810 01", DialectFailure.MISSING, "0020 80 1810 01 00000206"),
        (COE, "0020 40", DialectFailure.COMMAND, "0020 80 0000 00 01000405"),
        (COE, "0020 40 1810 01", DialectFailure.NO_RESPONSE, "0020 80 1810 01 00000008"),
        (SOE, "01 05 2000", DialectFailure.MISSING, "12 05 2000 0910"),
        (SOE, "02 05 2000 01", DialectFailure.SIZE, "14 05 2000 0230"),
        (SOE, "", DialectFailure.COMMAND, "12 000000 0110"),
        (FOE, "01 00000000 66", DialectFailure.MISSING, "05 00000000 02800000"),
        (FOE, "01 00000000", DialectFailure.FILE_NAME, "05 00000000 03800000"),
        (VOE, "64110000 0100 01", DialectFailure.NO_RESPONSE, "64110000 0100 03000000"),
        (VOE, "64", DialectFailure.COMMAND, "640000000000 02000000"),
    ],
)
def test_dialect_encodes_failures(kind, octets, failure, answer) -> None:
    body = dialect.encode_failure(kind, bytes.fromhex(octets), failure)
    assert body == bytes.fromhex(answer)


def test_a_slaves_own_code_goes_through() -> None:
    body = dialect.encode_failure(
        COE, bytes.fromhex("0020 40 1810 09"), DialectFailure.GENERAL, code=0x06090011
    )
    assert body == bytes.fromhex("0020 80 1810 09 11000906")
