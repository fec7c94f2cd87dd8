"""IDNs and vendors' messages to a slave elsewhere."""

from __future__ import annotations

import asyncio

import pytest

from devicebus.mailbox.protocol import MailboxSizes
from eap.aoe.ads_operation import ReadWrite, Write
from eap.appliance.services.gateway import remote_idns
from eap.appliance.services.gateway.remote_idns import RemoteIdns, RemoteVendor
from eap.codec.ads import AdsError, IndexGroup
from eap.gateway.elsewhere import ROOM, ElsewhereError
from tests.support.elsewhere import Station


def answer(speaker: RemoteIdns | RemoteVendor, body: str) -> list[str]:
    return [each.hex() for each in asyncio.run(speaker.answer(bytes.fromhex(body)))]


def test_elements_are_read_and_written() -> None:
    station = Station(b"\2\0\0\0")
    idns = RemoteIdns(station.link(), MailboxSizes.of_data(100))
    assert answer(idns, "01 40 2000") == ["02402000" + "02000000"]
    assert answer(idns, "0b 40 0100 0102") == []
    assert answer(idns, "03 40 2000 0304") == ["04402000"]
    assert station.asked[-1] == Write(IndexGroup.SOE, 0x0040_0020, b"\1\2\3\4")


def test_fragments_that_were_given_up_are_forgotten() -> None:
    station = Station()
    idns = RemoteIdns(station.link(), MailboxSizes.of_data(100))
    answer(idns, "0b 40 0100 0102")
    idns.reset()
    answer(idns, "03 40 2000 0304")
    assert station.asked[-1] == Write(IndexGroup.SOE, 0x0040_0020, b"\3\4")


def test_a_list_without_end(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(remote_idns, "MAX_WRITTEN", 3)
    idns = RemoteIdns(Station().link(), MailboxSizes.of_data(100))
    answer(idns, "0b 40 0100 0102")
    with pytest.raises(ElsewhereError) as caught:
        answer(idns, "0b 40 0100 0102")
    assert caught.value.result == AdsError.SIZE


def test_messages_of_a_vendor() -> None:
    station = Station(b"abc")
    assert answer(RemoteVendor(station.link()), "5a0e0000 0100") == ["616263"]
    message = bytes.fromhex("5a0e0000 0100")
    assert station.asked == [ReadWrite(IndexGroup.VOE, 0, ROOM, message)]
