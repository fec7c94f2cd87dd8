"""Mailbox requests as operations, for access rules."""

from __future__ import annotations

import pytest

from eap.ams.access import objects_of, service_of
from eap.ams.spec import AccessService, ObjectRange
from eap.codec.mailbox import MailboxType
from eap.gateway.requests import operation_of

COE, FOE, SOE = (MailboxType[name] for name in ("COE", "FOE", "SOE"))
VOE, EOE, AOE = (MailboxType[name] for name in ("VOE", "EOE", "AOE"))
READ, WRITE, FILES = (AccessService[name] for name in ("READ", "WRITE", "FILES"))
RAW, CONTROL = (AccessService[name] for name in ("RAW", "CONTROL"))
AMS, REST = "c0a800010201 e903 c0a800320101 0080", "00000000 01000000"


@pytest.mark.parametrize(
    ("kind", "octets", "service"),
    [
        (COE, "0020 40 1810 01 00000000", READ),
        (COE, "0020 41 1810 01 00000000", READ),
        (COE, "0020 23 1810 01 01020304", WRITE),
        (COE, "0020 20 4060 00 0600", WRITE),
        (COE, "0080 01 00 0000 0100", READ),
        (COE, "0080 03 00 0000 1810", READ),
        (COE, "0080 05 00 0000 1810 01 7f", READ),
        (COE, "0080", RAW),
        (COE, "0040 0102", RAW),
        (COE, "0050 0102", RAW),
        (COE, "0360", READ),
        (COE, "0371", READ),
        (COE, "", RAW),
        (SOE, "01 40 2000", READ),
        (SOE, "a1 40 2000", READ),
        (SOE, "03 40 2000 0102", WRITE),
        (SOE, "0b 40 0100 0102", WRITE),
        (SOE, "05 40 2000", RAW),
        (SOE, "01", RAW),
        (FOE, "01 00 00000000 66", READ),
        (FOE, "02 00 00000000 66", FILES),
        (VOE, "", RAW),
        (AOE, AMS + "0200 0400 0c000000" + REST + "02f30000 01001810 04000000", READ),
        (AOE, AMS + "0300 0400 0e000000" + REST + "02f30000 01001810 02000000 0102", WRITE),
        (AOE, AMS + "0400 0400 00000000" + REST, READ),
        (AOE, AMS + "0500 0400 08000000" + REST + "0500 0000 00000000", CONTROL),
        (AOE, AMS + "0200 0500 0c000000" + REST + "02f30000 01001810 04000000", RAW),
        (AOE, AMS + "0209 0400 00000000" + REST, RAW),
        (AOE, AMS + "0200 0400 00000000" + REST, RAW),
        (AOE, AMS, RAW),
        (EOE, "0600", READ),
        (EOE, "0200", RAW),
        (EOE, "0000", RAW),
    ],
)
def test_services(kind, octets, service) -> None:
    operation = operation_of(kind, bytes.fromhex(octets))
    assert operation is not None
    assert service_of(operation) is service


@pytest.mark.parametrize(
    ("kind", "octets"),
    [
        (COE, "0020 60 00000000000000"),
        (COE, "0020 00 01020304050607"),
        (COE, "0020 80 1810 01 00000000"),
        (COE, "0020 40"),
        (FOE, "03 00 01000000 66"),
        (FOE, "04 00 01000000"),
        (FOE, "05 00 01000000"),
        (FOE, ""),
    ],
)
def test_steps_of_transfers_have_no_operation(kind, octets) -> None:
    assert operation_of(kind, bytes.fromhex(octets)) is None


@pytest.mark.parametrize(
    ("octets", "touched"),
    [
        ("0020 40 1810 01 00000000", ObjectRange(0x1018, 0x1018, 1, 1)),
        ("0020 50 1810 00 00000000", ObjectRange(0x1018, 0x1018)),
        ("0020 31 1810 01 00000000", ObjectRange(0x1018, 0x1018)),
        ("0080 03 00 0000 1810", ObjectRange(0x1018, 0x1018)),
        ("0080 05 00 0000 1810 03 7f", ObjectRange(0x1018, 0x1018, 3, 3)),
    ],
)
def test_objects(octets, touched) -> None:
    operation = operation_of(COE, bytes.fromhex(octets))
    assert operation is not None
    assert objects_of(operation) == touched


@pytest.mark.parametrize(
    ("octets", "index"), [("0060", 0x1A00), ("0361", 0x1B03), ("0770", 0x1607)]
)
def test_remote_request_is_named_by_the_object_of_its_pdo(octets, index) -> None:
    operation = operation_of(COE, bytes.fromhex(octets))
    assert objects_of(operation) == ObjectRange(index, index)
