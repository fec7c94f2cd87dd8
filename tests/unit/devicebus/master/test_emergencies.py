"""Emergencies of slaves: decoded from what they send, and kept."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from devicebus.master.emergencies import (
    HISTORY,
    EmergencyLog,
    decode_emergency,
    describe_code,
    iter_present,
)
from devicebus.master.mailboxes import Unsolicited
from eap.codec.mailbox import MailboxType

# CoE header (service 1), error code 0x8611, register 0x20, five bytes of the vendor.
COE = bytes.fromhex("0010 1186 20 0102030405")
# SoE header (opcode 6, drive 2), then the same.
SOE = bytes.fromhex("46 00 0000 1186 20 0102030405")


def coe(code: int, station: int = 1001) -> Unsolicited:
    octets = COE[:2] + code.to_bytes(2, "little") + COE[4:]
    return Unsolicited(station, MailboxType.COE, octets)


def test_emergencies_of_both_protocols_are_decoded():
    found = decode_emergency(coe(0x8611), 5)
    assert (found.at_ns, found.protocol, found.drive) == (5, "CoE", 0)
    assert (found.code, found.register, found.data) == (0x8611, 0x20, b"\1\2\3\4\5")
    found = decode_emergency(Unsolicited(1001, MailboxType.SOE, SOE), 5)
    assert (found.protocol, found.drive, found.code, found.register) == ("SoE", 2, 0x8611, 0x20)


@pytest.mark.parametrize(
    ("kind", "octets"),
    [
        (MailboxType.COE, b""),
        (MailboxType.COE, COE[:-1]),
        (MailboxType.COE, b"\0\x40" + COE[2:]),  # a TxPDO
        (MailboxType.COE, b"\0\xf0" + COE[2:]),
        (MailboxType.SOE, SOE[:-1]),
        (MailboxType.SOE, b"\x45" + SOE[1:]),  # a notification
        (MailboxType.EOE, COE),
    ],
)
def test_other_and_malformed_messages_are_no_emergencies(kind, octets):
    assert decode_emergency(Unsolicited(1001, kind, octets), 0) is None


@given(
    kind=st.sampled_from([MailboxType.COE, MailboxType.SOE, MailboxType.VOE]),
    octets=st.binary(max_size=24),
)
def test_arbitrary_messages_never_raise(kind, octets):
    found = decode_emergency(Unsolicited(1001, kind, octets), 0)
    assert found is None or describe_code(found.code)


@pytest.mark.parametrize(
    ("code", "text"),
    [
        (0x0000, "no error"),
        (0x1000, "generic error"),
        (0x2320, "current, output side"),
        (0x4310, "temperature"),
        (0x8611, "monitoring"),
        (0xA001, "state transition"),
        (0xFF01, "device specific"),
        (0xB000, "unknown class"),
    ],
)
def test_code_is_described_by_its_class(code, text):
    assert describe_code(code) == text


def test_log_keeps_the_latest_of_each_slave_and_counts_all():
    log = EmergencyLog()
    for number in range(HISTORY + 5):
        log.take(coe(0x1000 + number), number)
    log.take(coe(0x2000, 1002), 99)
    assert log.of(1001).number == HISTORY + 5
    assert [each.code for each in log.of(1001).latest] == [
        0x1000 + n for n in range(5, HISTORY + 5)
    ]
    assert (log.of(1002).number, log.of(1003)) == (1, (0, ()))


def test_clearing_keeps_errors_that_were_not_taken_back():
    log = EmergencyLog()
    for code, station in ((0x1000, 1001), (0x2000, 1001), (0x3000, 1002), (0, 1002)):
        log.take(coe(code, station), 0)
    assert list(iter_present(log.of(1002).latest)) == []
    log.clear()
    assert [each.code for each in log.of(1001).latest] == [0x2000]
    assert log.of(1001).number == 1
    assert log.of(1002) == (0, ())
