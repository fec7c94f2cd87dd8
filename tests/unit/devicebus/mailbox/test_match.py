"""Requests and replies as they lie on the wire, and which belong together."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from devicebus.mailbox.conversation import answers, has_more
from eap.codec.ams import AmsHeader, encode_packet
from eap.codec.mailbox import MailboxType
from eap.ids import NetId

AOE, EOE, COE = MailboxType.AOE, MailboxType.EOE, MailboxType.COE
FOE, SOE, VOE = MailboxType.FOE, MailboxType.SOE, MailboxType.VOE
UPLOAD, DOWNLOAD = "0020 40 1810 01 00000000", "0020 2f 1810 01 05000000"
UPLOAD_SEGMENT, DOWNLOAD_SEGMENT = "0020 70 00000000000000", "0020 10 01020304050607"
LIST, ENTRY = "0080 01 00 0000 0100", "0080 05 00 0000 1810 01 7f"
READ, ACK, WRITE, DATA = "01 00 00000000 66", "04 00 03000000", "02 00 05000000 66", "0300 07000000"


@pytest.mark.parametrize(
    ("kind", "request_", "reply", "expected"),
    [
        (COE, UPLOAD, "0030 43 1810 01 02000000", True),
        (COE, UPLOAD, "0030 43 1810 02 02000000", False),
        (COE, UPLOAD, "0030 43 1910 01 02000000", False),
        (COE, UPLOAD, "0030 60 1810 01 00000000", False),
        (COE, UPLOAD, "0010 43 1810 01 02000000", False),
        (COE, UPLOAD, "0030", True),
        (COE, UPLOAD, "0030 43 18", True),
        (COE, UPLOAD, "", False),
        (COE, "0020", "0030 43 1810 01 02000000", False),
        (COE, UPLOAD, "0020 80 1810 01 00000206", True),
        (COE, UPLOAD, "0030 80 1810 01 00000206", True),
        (COE, UPLOAD, "0030 80 1810 05 00000206", False),
        (COE, UPLOAD, "0010 80 1810 01 00000206", False),
        (COE, DOWNLOAD, "0030 60 1810 01 00000000", True),
        (COE, DOWNLOAD, "0030 43 1810 01 00000000", False),
        (COE, UPLOAD_SEGMENT, "0030 11 0102030405060708", True),
        (COE, UPLOAD_SEGMENT, "0030 01 0102030405060708", False),
        (COE, UPLOAD_SEGMENT, "0030 30 00000000000000", False),
        (COE, UPLOAD_SEGMENT, "0030", True),
        (COE, UPLOAD_SEGMENT, "0020 80 0000 00 00000305", True),
        (COE, DOWNLOAD_SEGMENT, "0030 30 00000000000000", True),
        (COE, DOWNLOAD_SEGMENT, "0030 20 00000000000000", False),
        (COE, "0020 80 1810 01 00000206", "0030 80 1810 01 00000206", False),
        (COE, LIST, "0080 82 00 0200 0100 0010", True),
        (COE, LIST, "0080 82 00 0200 0200 0010", False),
        (COE, LIST, "0080 04 00 0000 0100 0700", False),
        (COE, LIST, "0080 07 00 0000 00000206", True),
        (COE, LIST, "0030 43 1810 01 02000000", False),
        (COE, LIST, "0080 02", True),
        (COE, LIST[:15], "0080 82 00 0100 9999", True),
        (COE, ENTRY, "0080 06 00 0000 1810 01 00 0700", True),
        (COE, ENTRY, "0080 06 00 0000 1810 02 00 0700", False),
        (COE, "0160", "0140 ff", True),
        (COE, "0160", "0240 ff", False),
        (COE, "0160", "0150 ff", False),
        (COE, "0170", "0150 ff", True),
        (COE, "0150 ff", "0150 ff", False),
        (FOE, READ, "0300 01000000 61", True),
        (FOE, READ, "0300 00000000 61", True),
        (FOE, READ, "0300 02000000 61", False),
        (FOE, READ, "0400 01000000", False),
        (FOE, READ, "0500 01800000", True),
        (FOE, READ, "0600 00000000", True),
        (FOE, READ, "0300", True),
        (FOE, ACK, "0300 04000000 61", True),
        (FOE, "0600 00006400", "0300 04000000 61", True),
        (FOE, "0600 00006400", "0400 04000000", False),
        (FOE, ACK, "0300 05000000 61", True),
        (FOE, ACK, "0300 03000000 61", False),
        (FOE, WRITE, "0400 00000000", True),
        (FOE, WRITE, "0400 05000000", False),
        (FOE, DATA, "0400 07000000", True),
        (FOE, DATA, "0400 08000000", True),
        (FOE, DATA, "0400 06000000", False),
        (FOE, DATA, "0300 07000000", False),
        (FOE, "0500 01800000", "0400 00000000", False),
        (SOE, "21 40 2000", "22 40 2000 0100", True),
        (SOE, "21 40 2000", "22 40 2100 0100", False),
        (SOE, "21 40 2000", "02 40 2000 0100", False),
        (SOE, "21 40 2000", "24 40 2000", False),
        (SOE, "21 40 2000", "2a 40 0300 0100", True),
        (SOE, "21 40 2000", "32 40 2100 0110", False),
        (SOE, "21 40", "22 40 2100 0100", True),
        (SOE, "21 40 2000", "22 40", True),
        (SOE, "23 40 2000 0607", "24 40 2000", True),
        (SOE, "23 40 2000 0607", "24 40 2100", False),
        (SOE, "23 40 2000 0607", "34 40 0100 0370", True),
        (EOE, "0200 0000 00000000", "0300 0000", True),
        (EOE, "0600 0000", "0700 0000", True),
        (EOE, "0600 0000", "0300 0000", False),
        (EOE, "0600 0000", "0000 0000", False),
        (EOE, "0600 0000", "", True),
        (VOE, "010000000200 6162", "010000000200 63", True),
        (VOE, "010000000200 6162", "010000000300 63", False),
        (VOE, "", "616263", True),
        (MailboxType.ERR, "01000200", "01000200", False),
    ],
)  # fmt: skip
def test_answers_by_protocol_and_content(
    kind: MailboxType, request_: str, reply: str, *, expected: bool
) -> None:
    assert answers(kind, bytes.fromhex(request_), bytes.fromhex(reply)) is expected


HERE, SLAVE = NetId.parse("1.2.3.4.5.6"), NetId.parse("6.5.4.3.2.1")
ASKED = encode_packet(AmsHeader(SLAVE, 1001, HERE, 300, 2, invoke_id=7), b"ask")


@pytest.mark.parametrize(
    ("source", "port", "command", "flags", "invoke_id", "expected"),
    [
        (SLAVE, 1001, 2, 5, 7, True),
        (SLAVE, 1001, 2, 4, 7, False),
        (SLAVE, 1001, 3, 5, 7, False),
        (SLAVE, 1001, 2, 5, 8, False),
        (SLAVE, 1002, 2, 5, 7, False),
        (HERE, 1001, 2, 5, 7, False),
    ],
)
def test_aoe_answer_has_the_target_as_source(
    source: NetId, port: int, command: int, flags: int, invoke_id: int, *, expected: bool
) -> None:
    header = AmsHeader(HERE, 300, source, port, command, flags, invoke_id=invoke_id)
    assert answers(AOE, ASKED, encode_packet(header, b"answer")) is expected


def test_aoe_answer_that_is_cut_is_left_to_the_conversation() -> None:
    assert answers(AOE, ASKED, ASKED[:31])


@pytest.mark.parametrize(
    ("kind", "reply", "expected"),
    [
        (COE, "0080 82 00 0200 0100", True),
        (COE, "0080 82 00 0000 0100", False),
        (COE, "0030 82 00 0200 0100", False),
        (COE, "0080 82", False),
        (SOE, "2a 40 0300 0100", True),
        (SOE, "22 40 2000 0100", False),
        (SOE, "2a", False),
        (FOE, "0300 01000000", False),
        (AOE, ASKED.hex(), False),
        (AOE, encode_packet(AmsHeader(SLAVE, 1, HERE, 1, 0x0902, 6), b"").hex(), True),
        (AOE, encode_packet(AmsHeader(SLAVE, 1, HERE, 1, 0x0902, 5), b"").hex(), False),
    ],
)
def test_has_more_by_protocol(kind: MailboxType, reply: str, *, expected: bool) -> None:
    assert has_more(kind, bytes.fromhex(reply)) is expected


@given(st.sampled_from(list(MailboxType)), st.binary(max_size=12), st.binary(max_size=12))
def test_answers_accepts_any_bytes(kind: MailboxType, request_: bytes, reply: bytes) -> None:
    assert answers(kind, request_, reply) in {True, False}
    assert has_more(kind, reply) in {True, False}
