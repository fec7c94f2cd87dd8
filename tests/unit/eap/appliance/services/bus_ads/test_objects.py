"""Entries, objects, lists and descriptions of a slave."""

from __future__ import annotations

import pytest

from eap.aoe.ads_operation import Read, Write
from eap.codec.ads import AdsError, IndexGroup
from eap.codec.sdoinfo import EntryDescription, ObjectDescription
from tests.support.busads import DRIVE, play

SENSOR = 1003
IDENTITY = bytes.fromhex("0400 5a0e0000 21560000 00000100 01000000")


def test_entries():
    async def scene(client, engine):
        assert await client.read(DRIVE, IndexGroup.SDO, 0x1018_0002) == IDENTITY[6:10]
        await client.write(DRIVE, IndexGroup.SDO, 0x6040_0000, b"\6\0")
        assert await client.read(DRIVE, IndexGroup.SDO, 0x6040_0000) == b"\6\0"
        both = await client.ask(DRIVE, IndexGroup.SDO, 0x6040_0000, b"\7\0")
        assert both == b"\7\0"
        assert await client.ask(DRIVE, IndexGroup.SDO, 0x6040_0000) == b"\7\0"

    play(scene)


def test_complete_access_has_no_subindex():
    async def scene(client, engine):
        for offset in (0x1018_0100, 0x1018_0103, 0x1018_0300):  # the last with a long time-out
            assert await client.read(DRIVE, IndexGroup.SDO, offset) == IDENTITY

    play(scene)


def test_complete_access_writes():
    async def scene(client, engine):
        whole = await client.read(SENSOR, IndexGroup.SDO, 0x8000_0100)
        changed = whole[:2] + b"\x33\0\0\0" + whole[6:]
        await client.write(SENSOR, IndexGroup.SDO, 0x8000_0100, changed)
        assert await client.read(SENSOR, IndexGroup.SDO, 0x8000_0001) == b"\x33\0\0\0"

    play(scene, "coe")


def test_long_values_go_in_segments():
    value = bytes(range(256)) * 8

    async def scene(client, engine):
        await client.write(SENSOR, IndexGroup.SDO, 0x8001_0000, value)
        assert await client.read(SENSOR, IndexGroup.SDO, 0x8001_0000) == value

    play(scene, "coe")


def test_sdo_information_without_its_headers():
    async def scene(client, engine):
        counts = await client.read(DRIVE, IndexGroup.OBJECT_LIST, 0)
        assert (len(counts), counts[:2]) == (12, b"\0\0")
        everything = await client.read(DRIVE, IndexGroup.OBJECT_LIST, 1 << 16)
        assert everything[:2] == b"\1\0"
        assert (len(everything) - 2) // 2 == int.from_bytes(counts[2:4], "little")
        octets = await client.read(DRIVE, IndexGroup.OBJECT_DESCRIPTION, 0x1018_0000)
        assert ObjectDescription.decode(octets).name == "Identity"
        octets = await client.read(DRIVE, IndexGroup.ENTRY_DESCRIPTION, 0x1018_0001)
        assert EntryDescription.decode(octets).bit_length == 32

    play(scene)


@pytest.mark.parametrize(
    ("operation", "result", "why"),
    [
        (Read(IndexGroup.SDO, 0x5555_0000, 4), AdsError.NOT_FOUND, "(0x06020000)"),
        (Read(IndexGroup.SDO, 0x1018_0077, 4), AdsError.NOT_FOUND, "(0x06090011)"),
        (Write(IndexGroup.SDO, 0x1018_0001, bytes(4)), AdsError.ACCESS, "(0x06010002)"),
        (Write(IndexGroup.SDO, 0x6040_0000, bytes(4)), AdsError.SIZE, "(0x060700"),
        (Read(IndexGroup.SDO, 0x1018_0401, 4), AdsError.INDEX_OFFSET, ""),
        (Read(IndexGroup.OBJECT_LIST, 9 << 16, 40), AdsError.GENERAL, "(0x06040043)"),
        (Write(IndexGroup.OBJECT_LIST, 0, b""), AdsError.INDEX_GROUP, ""),
    ],
)
def test_abort_codes_are_results_and_are_told(operation, result, why):
    async def scene(client, engine):
        assert (await client.do(DRIVE, operation)).result == result
        assert why in client.why

    play(scene)
