from __future__ import annotations

import pytest

from eap.ads.io import MasterSpace
from eap.ads.operation import AdsRefusedError
from tests.support.adsdevice import FakeMaster


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
def test_what_is_read(space, group: int, offset: int, length: int, octets: str) -> None:
    assert space.read(group, offset, length) == bytes.fromhex(octets)


@pytest.mark.parametrize(("group", "offset"), [(3, 0), (6, 1), (7, 1001), (9, 1004)])
def test_what_is_not_there(space, group: int, offset: int) -> None:
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
