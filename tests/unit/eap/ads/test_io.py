from __future__ import annotations

import pytest

from eap.ads.io import IoDevice, IoDeviceType, IoSpace, NoSegmentSpace
from eap.ads.operation import AdsRefusedError
from eap.codec.ads import IndexGroup
from eap.ids import NetId

SPACE = IoSpace(
    [
        IoDevice(1, "eap0", IoDeviceType.EAP, NetId.parse("1.2.3.4.3.1")),
        IoDevice(7, "Büs", IoDeviceType.MASTER, NetId.parse("1.2.3.4.2.1")),
    ]
)


@pytest.mark.parametrize(
    ("group", "offset", "octets"),
    [
        (0x5000, 1, "0200 0100 0700"),
        (0x5000, 2, "02000000"),
        (0x5001, 1, "6561703000"),
        (0x5007, 1, "42fc7300"),
        (0x5001, 5, "010203040301"),
        (0x5001, 7, "7000"),
        (0x5007, 7, "6f00"),
    ],
)
def test_what_adstool_reads(group: int, offset: int, octets: str) -> None:
    assert group in SPACE.groups
    assert SPACE.read(group, offset, 254) == bytes.fromhex(octets)
    assert SPACE.read(group, offset, 2) == bytes.fromhex(octets)[:2]


@pytest.mark.parametrize(
    ("group", "offset", "result"),
    [(0x5000, 5, "INDEX_OFFSET"), (0x5001, 2, "INDEX_OFFSET"), (0x5002, 1, "NOT_FOUND")],
)
def test_what_is_not_there(group: int, offset: int, result: str) -> None:
    with pytest.raises(AdsRefusedError, match=result):
        SPACE.read(group, offset, 4)


def test_device_without_segment_answers_as_an_empty_one() -> None:
    space = NoSegmentSpace()
    assert IndexGroup.RAW_COMMAND in space.groups
    with pytest.raises(AdsRefusedError, match="TIMEOUT: no segment"):
        space.read_write(IndexGroup.RAW_COMMAND, 0, 16, bytes(16))
