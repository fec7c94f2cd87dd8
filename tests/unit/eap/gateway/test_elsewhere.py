from __future__ import annotations

import pytest

from eap.aoe.ads_operation import Read, Write
from eap.codec.ads import AdsError, IndexGroup
from eap.codec.mailbox import MailboxType
from eap.codec.sdoinfo import SdoInfoOpcode
from eap.codec.soe import SoeHeader, SoeOpcode
from eap.errors import CodecError
from eap.gateway import elsewhere
from eap.gateway.elsewhere import ROOM, ElsewhereError
from eap.gateway.refusal import Reason
from eap.od.abort import AbortCode

COE, FOE, SOE, VOE = MailboxType.COE, MailboxType.FOE, MailboxType.SOE, MailboxType.VOE


def test_who_did_not_answer_is_told_apart_from_who_refused():
    assert elsewhere.reason_for(AdsError.HOST_UNREACHABLE) is Reason.UNREACHABLE
    assert elsewhere.reason_for(AdsError.NOT_FOUND) is None
    assert elsewhere.abort_for(AdsError.NOT_FOUND) is AbortCode.NO_OBJECT
    assert elsewhere.abort_for(0x7FF) is AbortCode.GENERAL


@pytest.mark.parametrize(
    ("kind", "request_", "result", "answer"),
    [
        (COE, "0020 40 1810 02 00000000", AdsError.NOT_FOUND, "0020 80 1810 02 00000206"),
        (COE, "0020 60 00", AdsError.NOT_FOUND, None),
        (SOE, "a1 40 2000", AdsError.NOT_FOUND, "b2 40 2000 0110"),
        (SOE, "03 40 2000", 0x7FF, "14 40 2000 0b80"),
        (SOE, "05 40 2000", AdsError.NOT_FOUND, None),
        (
            FOE,
            "01 00 00000000 61",
            AdsError.NOT_FOUND,
            "05 00 01800000" + b"file not found: ADS error 0x70c (NOT_FOUND)".hex(),
        ),
        (VOE, "5a0e0000 0100", AdsError.NOT_FOUND, None),
    ],
)
def test_refusals_in_the_protocol_of_the_request(kind, request_, result, answer):
    told = elsewhere.refusal_for(kind, bytes.fromhex(request_), result)
    assert told == (None if answer is None else bytes.fromhex(answer))


def test_an_error_says_what_it_means():
    assert str(ElsewhereError(AdsError.TIMEOUT)) == "error 0x719 (no answer in time)"


def test_offsets():
    assert elsewhere.sdo_offset(0x1018, 2, complete=False) == 0x1018_0002
    assert elsewhere.sdo_offset(0x1018, 1, complete=True) == 0x1018_0100
    head = SoeHeader(SoeOpcode.READ_REQUEST, 0, 0, 3, 0x42, 32)
    assert elsewhere.idn_query(head) == Read(IndexGroup.SOE, 0x0342_0020, ROOM)
    assert elsewhere.idn_query(head, b"1") == Write(IndexGroup.SOE, 0x0342_0020, b"1")
    assert elsewhere.vendor_query(b"abc").data == b"abc"


@pytest.mark.parametrize(
    ("body", "opcode", "group", "offset"),
    [
        ("01 00 0000 0100", SdoInfoOpcode.LIST_RESPONSE, IndexGroup.OBJECT_LIST, 0x0001_0000),
        (
            "03 00 0000 1810",
            SdoInfoOpcode.OBJECT_RESPONSE,
            IndexGroup.OBJECT_DESCRIPTION,
            0x1018_0000,
        ),
        (
            "05 00 0000 1810 02 7f",
            SdoInfoOpcode.ENTRY_RESPONSE,
            IndexGroup.ENTRY_DESCRIPTION,
            0x1018_7F02,
        ),
    ],
)
def test_sdo_information(body, opcode, group, offset):
    assert elsewhere.info_query(bytes.fromhex(body)) == (opcode, Read(group, offset, ROOM))


def test_what_asks_for_nothing():
    assert elsewhere.info_query(bytes.fromhex("02 00 0000 0100")) is None
    with pytest.raises(CodecError):
        elsewhere.info_query(b"\1")
