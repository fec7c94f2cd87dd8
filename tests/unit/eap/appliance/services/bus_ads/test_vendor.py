"""VoE by ADS: messages with their headers."""

from __future__ import annotations

from eap.aoe.ads_operation import Read, ReadWrite, Write
from eap.appliance.bus_request import AskMailbox
from eap.codec.ads import AdsError, IndexGroup
from tests.support.busads import DRIVE, play

HEAD = bytes.fromhex("5a0e0000 0700")


def test_message_and_its_answer():
    async def scene(client, engine):
        assert await client.ask(DRIVE, IndexGroup.VOE, 0, HEAD + b"hello") == HEAD + b"hello"
        assert await client.ask(DRIVE, IndexGroup.VOE, 0, HEAD) == HEAD

    play(scene)


def test_message_without_an_answer():
    async def scene(client, engine):
        await client.write(DRIVE, IndexGroup.VOE, 0, HEAD + b"hello")
        (sent,) = engine.of(AskMailbox)
        assert (sent.request, sent.expects_reply) == (HEAD + b"hello", False)

    play(scene)


def test_what_is_no_message():
    async def scene(client, engine):
        for operation in (Write(IndexGroup.VOE, 0, HEAD[:5]), ReadWrite(IndexGroup.VOE, 0, 9, b"")):
            assert (await client.do(DRIVE, operation)).result == AdsError.SIZE
        assert (await client.do(DRIVE, Read(IndexGroup.VOE, 0, 9))).result == AdsError.SERVICE

    play(scene)
