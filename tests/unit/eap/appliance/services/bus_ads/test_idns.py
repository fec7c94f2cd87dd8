"""Elements of IDNs and procedure commands by ADS."""

from __future__ import annotations

import pytest

from eap.aoe.ads_operation import Read, Write
from eap.appliance.services.bus_ads import idns
from eap.codec.ads import AdsError, IndexGroup, SoePlace
from eap.codec.soe import Element, Idn
from tests.support.busads import DRIVE, play, until

MODE = Idn.parse("S-0-0032")
NAME = b"\x16\0\x16\0Primary operation mode"
ATTRIBUTE = bytes.fromhex("01001200")
COMMAND = Idn.parse("S-0-0099")


def place(idn: Idn, elements: int = 0, **more: int) -> int:
    return int.from_bytes(SoePlace(idn.number, elements, **more).encode(), "little")


def test_all_elements():
    async def scene(client, engine):
        async def read(elements):
            return await client.read(DRIVE, IndexGroup.SOE, place(MODE, elements))

        assert await read(Element.NAME) == NAME
        assert await read(Element.ATTRIBUTE) == ATTRIBUTE
        assert await read(Element.VALUE) == b"\2\0\0\0"
        several = Element.NAME | Element.ATTRIBUTE | Element.VALUE
        assert await read(several) == NAME + ATTRIBUTE + b"\2\0\0\0"

    play(scene)


def test_value_is_written():
    async def scene(client, engine):
        value = place(MODE, Element.VALUE)
        await client.write(DRIVE, IndexGroup.SOE, value, b"\3\0\0\0")
        assert await client.ask(DRIVE, IndexGroup.SOE, value) == b"\3\0\0\0"

    play(scene)


@pytest.mark.parametrize(
    ("operation", "result", "why"),
    [
        (Read(IndexGroup.SOE, place(Idn(True, 7, 4000), 0x40), 4), AdsError.NOT_FOUND, "0x1001"),
        (Read(IndexGroup.SOE, place(MODE, Element.UNIT), 4), AdsError.NOT_FOUND, "0x4001"),
        (Read(IndexGroup.SOE, place(MODE, 0x40, drive=5), 4), AdsError.NOT_FOUND, "0x800A"),
        (Write(IndexGroup.SOE, place(MODE, Element.NAME), b"\1\0\1\0a"), AdsError.ACCESS, "0x2004"),
        (Read(IndexGroup.SOE, place(MODE, 0x40, reserved=1), 4), AdsError.INDEX_OFFSET, ""),
        (Write(IndexGroup.SOE, place(MODE, is_command=1), b"\7\0"), AdsError.VALUE, "by 3"),
    ],
)
def test_refusals(operation, result, why):
    async def scene(client, engine):
        assert (await client.do(DRIVE, operation)).result == result
        assert why in client.why

    play(scene)


def test_command_is_executed_and_cleared():
    async def scene(client, engine):
        command = place(COMMAND, is_command=1)
        await client.write(DRIVE, IndexGroup.SOE, command)
        assert await client.read(DRIVE, IndexGroup.SOE, command) == b"\0\0"
        await client.write(DRIVE, IndexGroup.SOE, command, b"\3\0")

    play(scene)


def test_command_that_takes_long_is_asked_for_again(monkeypatch):
    monkeypatch.setattr(idns, "ANSWER_S", 0.001)

    async def scene(client, engine):
        command = Write(IndexGroup.SOE, place(COMMAND, is_command=1), b"")
        assert (await client.do(DRIVE, command)).result == AdsError.BUSY
        assert client.why == "S-0-0099 is being executed: ask again"
        value = await client.read(DRIVE, IndexGroup.SOE, place(MODE, Element.VALUE))
        assert value == b"\2\0\0\0"  # the drive can be talked to meanwhile

        async def is_done():
            outcome = await client.do(DRIVE, command)
            assert outcome.result in {AdsError.NONE, AdsError.BUSY}
            return not outcome.result

        await until(is_done)

    play(scene)


def test_command_that_the_drive_refuses():
    async def scene(client, engine):
        home = Write(IndexGroup.SOE, place(Idn.parse("S-0-0148"), is_command=1), b"")
        for _ in range(2):  # nothing of the first is left
            assert (await client.do(DRIVE, home)).result == AdsError.STATE
            assert "cannot be executed now" in client.why

    play(scene)


def test_commands_are_not_without_number(monkeypatch):
    monkeypatch.setattr(idns, "MAX_COMMANDS", 0)

    async def scene(client, engine):
        command = Write(IndexGroup.SOE, place(COMMAND, is_command=1), b"")
        assert (await client.do(DRIVE, command)).result == AdsError.NO_MEMORY

    play(scene)
