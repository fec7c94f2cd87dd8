from __future__ import annotations

import pytest

from eap.ads.objects import ObjectSpace
from eap.ads.request import AdsRefusedError
from eap.codec.ads import AdsError, IndexGroup
from eap.od import info
from eap.od.dictionary import ObjectDictionary
from eap.od.model import RO, RW, RW_PREOP, OdState, array, variable

SDO = IndexGroup.SDO


@pytest.fixture
def dictionary() -> ObjectDictionary:
    return ObjectDictionary(
        [
            variable(0x1000, "Type", "UDINT", RO, 7),
            variable(0x1001, "Setting", "USINT", RW_PREOP, 1),
            array(0x2000, "Values", "UINT", [1, 2], RW),
        ]
    )


@pytest.fixture
def space(dictionary: ObjectDictionary) -> ObjectSpace:
    return ObjectSpace(dictionary, lambda: OdState.OP)


def test_entries_and_objects_are_read_and_written(space) -> None:
    assert space.read(SDO, 0x1000_0000, 80) == bytes.fromhex("07000000")
    space.write(SDO, 0x2000_0002, b"\x34\x12")
    assert space.read(SDO, 0x2000_0100, 6) == bytes.fromhex("0200 0100 3412")
    space.write(SDO, 0x2000_0100, bytes.fromhex("0200 0300 0400"))
    assert space.read(SDO, 0x2000_0001, 2) == b"\3\0"


def test_reading_after_writing(space) -> None:
    assert space.read_write(SDO, 0x2000_0001, 2, b"\5\6") == b"\5\6"
    assert space.read_write(SDO, 0x2000_0001, 2, b"") == b"\5\6"


def test_descriptions(space, dictionary) -> None:
    for group, offset, octets in (
        (IndexGroup.OBJECT_LIST, 0x0001_0000, info.object_list(dictionary, 1)),
        (IndexGroup.OBJECT_DESCRIPTION, 0x2000_0000, info.object_description(dictionary, 0x2000)),
        (
            IndexGroup.ENTRY_DESCRIPTION,
            0x2000_0702,
            info.entry_description(dictionary, 0x2000, 2, 7),
        ),
    ):
        assert group in space.groups
        assert space.read(group, offset, 100) == octets


@pytest.mark.parametrize(
    ("attempt", "result"),
    [
        (lambda s: s.read(SDO, 0x3000_0000, 4), "NOT_FOUND: .*3000"),
        (lambda s: s.read(SDO, 0x1000_0001, 4), "NOT_FOUND"),
        (lambda s: s.read(SDO, 0x1000_0200, 4), "INDEX_OFFSET"),
        (lambda s: s.read(SDO, 0x1000_0000, 3), "SIZE"),
        (lambda s: s.read(IndexGroup.OBJECT_LIST, 0x0009_0000, 80), "GENERAL"),
        (lambda s: s.write(SDO, 0x1000_0000, bytes(4)), "GENERAL: .*1000"),
        (lambda s: s.write(SDO, 0x1001_0000, b"\2"), "GENERAL"),
        (lambda s: s.write(SDO, 0x2000_0200, b"\2"), "INDEX_OFFSET"),
        (lambda s: s.write(IndexGroup.OBJECT_LIST, 0, b"\0"), "INDEX_GROUP"),
        (lambda s: s.watch(IndexGroup.OBJECT_LIST, 0, 10), "ACCESS"),
        (lambda s: s.watch(SDO, 0x1000_0000, 5), "SIZE"),
        (lambda s: s.watch(SDO, 0x3000_0000, 5), "NOT_FOUND"),
    ],
)
def test_refusals(space, attempt, result: str) -> None:
    with pytest.raises(AdsRefusedError, match=result):
        attempt(space)


def test_object_space_maps_aborts_to_given_results(dictionary) -> None:
    space = ObjectSpace(dictionary, lambda: OdState.OP, lambda _: AdsError.ACCESS)
    with pytest.raises(AdsRefusedError, match="ACCESS"):
        space.read(SDO, 0x3000_0000, 4)


def test_entries_are_watched(space, dictionary) -> None:
    source = space.watch(SDO, 0x2000_0001, 2)
    assert source() == b"\1\0"
    space.write(SDO, 0x2000_0001, b"\x09\0")
    assert source() == b"\x09\0"
    dictionary.remove(0x2000)
    with pytest.raises(AdsRefusedError, match="NOT_FOUND"):
        source()
