"""Commands to a simulated segment."""

from __future__ import annotations

import asyncio
import socket

import pytest

from devicebus.errors import BusError
from eap.services.slaves.segment_link import SegmentLink
from tests.support.eventually import settle
from tests.support.fakeengine import FakeSegment
from tests.support.loopbus import LoopBus
from tests.support.virtualtime import run_virtual

CUT = {"kind": "cut", "slave": "sensor"}


def play(scene, timeout_s=2.0):
    async def run():
        segment = FakeSegment(LoopBus("coe"))
        link = SegmentLink(segment.services, timeout_s=timeout_s)
        try:
            await scene(segment, link)
        finally:
            link.close()
            segment.close()

    run_virtual(run())


def test_faults_and_values():
    async def scene(segment, link):
        await link.command(CUT)
        await link.command(CUT | {"end": True})
        await link.command({"set": {"slave": "buttons", "entry": "start", "value": True}})
        with pytest.raises(ValueError, match="no slave 'nobody'"):
            await link.command({"kind": "cut", "slave": "nobody"})

    play(scene)


def test_several_at_once_get_their_own_answers():
    async def scene(segment, link):
        bad = {"kind": "cut", "slave": "nobody"}
        outcomes = await asyncio.gather(
            *(link.command(each) for each in (CUT, bad, CUT)), return_exceptions=True
        )
        assert [type(each) for each in outcomes] == [type(None), ValueError, type(None)]

    play(scene)


def test_command_to_silent_segment_fails():
    async def scene(segment, link):
        segment.is_silent = True
        with pytest.raises(BusError, match="does not answer"):
            await link.command(CUT)
        segment.is_silent = False
        for message in ({"id": 7, "ok": True}, {"ok": False}, [1]):  # none that is awaited
            segment.say(message)
        await link.command(CUT)

    play(scene, timeout_s=0.05)


def test_pair_that_is_closed():
    async def run():
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        link = SegmentLink(ours)
        theirs.close()
        await settle()
        with pytest.raises(BusError):
            await link.command(CUT)
        return link

    link = run_virtual(run())
    link.close()  # also behind the end of its loop
