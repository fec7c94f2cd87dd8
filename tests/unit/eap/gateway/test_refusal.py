"""Errors speak the requester's protocol, and tshark's and our own decoders read them."""

from __future__ import annotations

import itertools
from pathlib import Path

import pytest

from eap.codec.ads import AdsError
from eap.codec.ams import AmsCommand, AmsHeader, StateFlags, decode_packet, encode_packet
from eap.codec.foe import Busy, FoeErrorCode, FoeOpcode, decode_message, text_of
from eap.codec.mailbox import MailboxError, MailboxType
from eap.codec.soe import SoeErrorCode, SoeHeader, error_code_of
from eap.gateway.error_table import Cause
from eap.gateway.requests import error_reply
from eap.ids import NetId

COE, FOE, SOE, VOE, EOE, AOE = (
    MailboxType[name] for name in ("COE", "FOE", "SOE", "VOE", "EOE", "AOE")
)
UPLOAD = bytes.fromhex("0020 40 1810 02 00000000")
MAILBOX = {
    Cause.NO_SLAVE: "0100 0500",
    Cause.NO_PROTOCOL: "0100 0200",
    Cause.TIMEOUT: "0100 0900",
    Cause.TOO_LONG: "0100 0800",
}


@pytest.mark.parametrize(
    ("reason", "code"),
    [
        (Cause.NO_SLAVE, "00000206"),
        (Cause.NO_MAILBOX, "21000008"),
        (Cause.NO_PROTOCOL, "00000106"),
        (Cause.TIMEOUT, "00000405"),
        (Cause.TOO_LONG, "05000106"),
    ],
)
def test_an_sdo_is_aborted(reason, code) -> None:
    answer = error_reply(COE, UPLOAD, reason)
    assert answer == (COE, bytes.fromhex("0020 80 1810 02" + code))


def test_sdo_information_has_an_error_of_its_own() -> None:
    answer = error_reply(COE, bytes.fromhex("0080 03 00 0000 1810"), Cause.TIMEOUT)
    assert answer == (COE, bytes.fromhex("0080 07 00 0000 00000405"))


def test_an_idn_is_refused() -> None:
    answer = error_reply(SOE, bytes.fromhex("a1 40 2000"), Cause.TIMEOUT)
    header = SoeHeader.decode(answer.body)
    assert (header.opcode, header.error, header.drive, header.idn) == (2, 1, 5, 32)
    assert error_code_of(answer.body) == SoeErrorCode.GENERAL
    assert error_reply(SOE, bytes.fromhex("03 40 2000"), Cause.TOO_LONG).body[0] & 0x17 == 0x14


def test_a_file_transfer_ends_with_words() -> None:
    answer = error_reply(FOE, bytes.fromhex("01 00 00000000 66"), Cause.NO_SLAVE, "no slave 1009")
    header, body = decode_message(answer.body)
    assert (header.opcode, header.number) == (FoeOpcode.ERROR, FoeErrorCode.NOT_FOUND)
    assert text_of(body) == "no slave 1009"


@pytest.mark.parametrize(
    ("reason", "words"), [(Cause.BUSY, "another client"), (Cause.TOO_FAST, "a second")]
)
def test_error_reply_of_a_busy_file_is_busy(reason, words) -> None:
    header, body = decode_message(error_reply(FOE, bytes.fromhex("01 00 00000000 66"), reason).body)
    assert header.opcode is FoeOpcode.BUSY
    assert Busy.of(header.number) == Busy(0, 100)
    assert words in text_of(body)


def test_an_ams_packet_comes_back() -> None:
    slave, client = NetId.parse("1.2.3.4.5.6"), NetId.parse("6.5.4.3.2.1")
    asked = AmsHeader(slave, 1001, client, 7, AmsCommand.READ, StateFlags.ADS, invoke_id=99)
    answer = error_reply(AOE, encode_packet(asked, bytes(12)), Cause.TIMEOUT)
    header, body = decode_packet(answer.body)
    assert (header.target, header.target_port, header.invoke_id) == (client, 7, 99)
    assert (header.error_code, bytes(body)) == (AdsError.TIMEOUT, b"")


@pytest.mark.parametrize(("reason", "octets"), MAILBOX.items())
def test_error_reply_of_voe_and_eoe_is_a_mailbox_error(reason, octets) -> None:
    expected = MailboxType.ERR, bytes.fromhex(octets)
    assert error_reply(VOE, b"anything", reason) == expected
    assert error_reply(EOE, b"", reason) == expected
    assert error_reply(AOE, b"short", reason) == expected
    assert error_reply(COE, b"", reason) == expected
    assert error_reply(COE, b"\0\x50", reason) == expected
    assert error_reply(SOE, b"\x05\0\0\0", reason) == expected
    assert error_reply(FOE, b"", reason) == expected


def test_protocol_that_is_not_spoken_is_refused_in_that_protocol() -> None:
    soe = error_reply(SOE, bytes.fromhex("a1 40 2000"), Cause.NO_PROTOCOL)
    header = SoeHeader.decode(soe.body)
    assert (soe.type, header.opcode, header.error, header.drive, header.idn) == (SOE, 2, 1, 5, 32)
    assert error_code_of(soe.body) == SoeErrorCode.NO_IDN
    foe = error_reply(FOE, bytes.fromhex("01 00 00000000 66"), Cause.NO_PROTOCOL)
    header, body = decode_message(foe.body)
    assert (foe.type, header.opcode) == (FOE, FoeOpcode.ERROR)
    assert text_of(body) == "it does not speak this protocol"


def test_time_outs_missing_slaves_and_protocols_and_lengths_differ_in_every_protocol() -> None:
    requests = {COE: UPLOAD, SOE: bytes.fromhex("01 40 2000"), FOE: b"\1\0\0\0\0\0f", VOE: bytes(6)}
    reasons = (Cause.NO_SLAVE, Cause.NO_PROTOCOL, Cause.TIMEOUT, Cause.TOO_LONG)
    for kind, request in requests.items():
        answers = [error_reply(kind, request, reason) for reason in reasons]
        assert all(one != other for one, other in itertools.combinations(answers, 2))


def test_every_request_has_an_answer() -> None:
    for reason, kind, size in itertools.product(Cause, MailboxType, range(8)):
        answer = error_reply(kind, bytes((0x21,)) * size, reason)
        assert answer.type in {kind, MailboxType.ERR}
        assert answer.body
        assert reason.text
        assert isinstance(reason.value.mailbox, MailboxError)


def test_the_page_of_the_gateway_has_each_code() -> None:
    page = (Path(__file__).parents[4] / "docs" / "gateway.md").read_text()
    for reason in Cause:
        codes = reason.value
        numbers = f"`0x{codes.sdo:08X}` | `0x{codes.soe:04X}` | `0x{codes.foe:04X}`"
        row = f"| {codes.text} | {int(codes.mailbox)} | {numbers} | `0x{int(codes.ads):X}` |"
        assert row in page
