"""I/O server and the masters that it lists."""

from __future__ import annotations

import pytest

from eap.ads.io import IoDevice, IoDeviceType, IoSpace, MasterSpace, NoSegmentSpace
from eap.ads.request import AdsRefusedError
from eap.codec.ads import IndexGroup
from eap.ids import NetId
from tests.support.adsdevice import FakeMaster

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
def test_io_space_answers_reads_of_adstool(group: int, offset: int, octets: str) -> None:
    assert group in SPACE.groups
    assert SPACE.read(group, offset, 254) == bytes.fromhex(octets)
    assert SPACE.read(group, offset, 2) == bytes.fromhex(octets)[:2]


@pytest.mark.parametrize(
    ("group", "offset", "result"),
    [(0x5000, 5, "INDEX_OFFSET"), (0x5001, 2, "INDEX_OFFSET"), (0x5002, 1, "NOT_FOUND")],
)
def test_io_space_refuses_unknown_devices_and_offsets(group: int, offset: int, result: str) -> None:
    with pytest.raises(AdsRefusedError, match=result):
        SPACE.read(group, offset, 4)


def test_device_without_segment_answers_as_empty_master() -> None:
    space = NoSegmentSpace()
    assert IndexGroup.RAW_COMMAND in space.groups
    with pytest.raises(AdsRefusedError, match="TIMEOUT: no segment"):
        space.read_write(IndexGroup.RAW_COMMAND, 0, 16, bytes(16))


@pytest.fixture
def master() -> FakeMaster:
    return FakeMaster()


@pytest.fixture
def space(master: FakeMaster) -> MasterSpace:
    return MasterSpace(master)


@pytest.mark.parametrize(
    ("group", "offset", "length", "octets"),
    [
        (3, 0x100, 2, "0800"),
        (6, 0, 2, "0300"),
        (7, 0, 6, "e903 ea03 eb03"),
        (7, 0, 5, "e903 ea03"),
        (7, 0, 100, "e903 ea03 eb03"),
        (9, 0, 6, "0800 1400 0801"),
        (9, 0, 3, "0800"),
        (9, 1003, 2, "0801"),
        (9, 1003, 1, "08"),
    ],
)
def test_master_space_reads_states_and_addresses(
    space, group: int, offset: int, length: int, octets: str
) -> None:
    assert space.read(group, offset, length) == bytes.fromhex(octets)


@pytest.mark.parametrize(("group", "offset"), [(3, 0), (6, 1), (7, 1001), (9, 1004)])
def test_master_refuses_unknown_offsets_and_slaves(space, group: int, offset: int) -> None:
    with pytest.raises(AdsRefusedError, match="INDEX_OFFSET"):
        space.read(group, offset, 2)


def test_states_are_requested(space, master) -> None:
    space.write(3, 2, b"")
    space.write(9, 1001, b"\4\0")
    assert master.asked == [(2,), (1001, 4)]


@pytest.mark.parametrize(
    ("group", "offset", "data", "result"),
    [
        (3, 5, b"", "VALUE"),
        (3, 0x100, b"\x08\0", "VALUE"),
        (9, 1001, b"\5\0", "VALUE"),
        (9, 1001, b"\4", "SIZE"),
        (9, 1009, b"\4\0", "INDEX_OFFSET"),
        (9, 0, b"\4\0", "INDEX_OFFSET"),
        (6, 0, b"\4\0", "ACCESS"),
    ],
)
def test_requests_that_are_refused(space, master, group, offset, data, result) -> None:
    with pytest.raises(AdsRefusedError, match=result):
        space.write(group, offset, data)
    assert not master.asked


def test_states_are_watched(space, master) -> None:
    one, everyone = space.watch(9, 1002, 2), space.watch(9, 0, 6)
    assert (one(), everyone()) == (b"\x14\0", bytes.fromhex("0800 1400 0801"))
    del master.all[1:]
    with pytest.raises(AdsRefusedError, match="INDEX_OFFSET"):
        one()
    with pytest.raises(AdsRefusedError, match="SIZE"):
        everyone()
    with pytest.raises(AdsRefusedError, match="SIZE"):
        space.watch(9, 0, 6)
