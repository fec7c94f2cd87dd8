"""AoE to the EAP devices of this appliance: the first part of a router (ETG.1020, AoE).

A packet is for whom its target NetID names.  Here that is an EAP port of a station behind the
socket that the packet came by; what is for nobody here is answered with the error of the AMS
header that says so.  The requests of a station are done one after the other, in the order in which
they came.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Awaitable, Callable, Collection, Mapping, Sequence
from typing import NamedTuple, TypeAlias

from eap.aoe.answer import AmsAnswer, response_to
from eap.aoe.fragment import Assembler, iter_fragments
from eap.codec.ads import AdsError
from eap.codec.ams import AmsCommand, AmsHeader, StateFlags, decode_packet
from eap.errors import CodecError
from eap.ids import NetId

DEVICE_PORT = 0xFFFF
"""AMS port of an EAP device."""
MAX_WAITING = 64
"""Requests of one station that came by frames and wait for their turn."""

Services: TypeAlias = Callable[[int, bytes], Awaitable[AmsAnswer]]
"""Answers the command of a request with the data behind its header."""
Reply: TypeAlias = Callable[[bytes], None]
"""Sends a packet back the way a request came."""

logger = logging.getLogger(__name__)


class _Request(NamedTuple):
    header: AmsHeader
    body: bytes
    services: Services
    finish: Callable[[AmsAnswer], None]


class AoeDesk:
    """The devices of one station, and the requests that wait for them.

    Args:
        devices: Those that answer, by NetID.
        machines: All NetIDs of the station.
    """

    def __init__(self, devices: Mapping[NetId, Services], machines: Collection[NetId]) -> None:
        self._devices = devices
        self._machines = frozenset(machines)
        self._waiting: asyncio.Queue[_Request] = asyncio.Queue(MAX_WAITING)
        self._turn = asyncio.Lock()

    def find(self, header: AmsHeader) -> Services | AdsError:
        """Return who answers a request, or why nobody does."""
        if header.target not in self._machines:
            return AdsError.TARGET_MACHINE
        services = self._devices.get(header.target)
        if services is None or header.target_port != DEVICE_PORT:
            return AdsError.TARGET_PORT
        return AdsError.COMMAND if header.command not in _COMMANDS else services

    def put(
        self,
        header: AmsHeader,
        body: bytes,
        services: Services,
        finish: Callable[[AmsAnswer], None],
    ) -> None:
        """Have *services* answer a request; *finish* is called with the answer."""
        try:
            self._waiting.put_nowait(_Request(header, body, services, finish))
        except asyncio.QueueFull:
            finish(AmsAnswer(error_code=AdsError.MAILBOX_FULL))

    async def serve(self) -> None:
        """Answer requests until cancelled."""
        while True:
            request = await self._waiting.get()
            request.finish(await self.ask(request.header, request.body, request.services))
            self._waiting.task_done()

    async def ask(self, header: AmsHeader, body: bytes, services: Services) -> AmsAnswer:
        """Have *services* answer a request when its turn comes; who may wait waits here."""
        async with self._turn:
            try:
                return await services(header.command, body)
            except Exception:
                logger.exception("AoE request from %s failed", header.source)
                return AmsAnswer(error_code=AdsError.INTERNAL)

    async def wait_idle(self) -> None:
        """Wait until nothing waits."""
        await self._waiting.join()


def find_desk(desks: Sequence[AoeDesk], header: AmsHeader) -> tuple[AoeDesk, Services] | AdsError:
    """Return which of *desks* is meant and who answers there, or why nobody does."""
    error = AdsError.TARGET_MACHINE
    for desk in desks:
        found = desk.find(header)
        if not isinstance(found, AdsError):
            return desk, found
        if found is not AdsError.TARGET_MACHINE:
            error = found
    return error


class AoeDoor:
    """Where packets come in, by one socket or one connection.

    Args:
        desks: Of the stations behind it.
        room: Octets of the longest packet that goes back in one piece.
    """

    def __init__(self, desks: Sequence[AoeDesk], room: int) -> None:
        self._desks = desks
        self._room = room
        self._assembler = Assembler()
        self._number = 0

    def receive_packet(
        self, data: bytes, reply: Reply, now_ns: int, *, for_all: bool = False
    ) -> bool:
        """Act on a packet; return whether it was one that can be acted on.

        Args:
            data: Header and what follows it.
            reply: For its answer, called now or later.
            now_ns: The time on the monotonic clock.
            for_all: Whether it came by multicast: who is not meant says nothing.
        """
        try:
            header, body = decode_packet(data)
            if header.state_flags & StateFlags.RESPONSE:
                return False  # nothing was asked from here
            if header.command == AmsCommand.FRAGMENT:
                packet, acknowledgement = self._assembler.receive(header, bytes(body), now_ns)
                if acknowledgement is not None:
                    reply(acknowledgement)
                if packet is None:
                    return True
                header, body = decode_packet(packet)
        except CodecError:
            return False
        self._dispatch(header, bytes(body), reply, for_all=for_all)
        return True

    def _dispatch(self, header: AmsHeader, body: bytes, reply: Reply, *, for_all: bool) -> None:
        def finish(answer: AmsAnswer) -> None:
            self._answer(header, answer, reply)

        found = find_desk(self._desks, header)
        if not isinstance(found, AdsError):
            desk, services = found
            desk.put(header, body, services, finish)
        elif not (for_all and found is AdsError.TARGET_MACHINE):
            finish(AmsAnswer(error_code=found))

    def _answer(self, header: AmsHeader, answer: AmsAnswer, reply: Reply) -> None:
        if header.state_flags & StateFlags.NO_RETURN:
            return
        packet = response_to(header, answer)
        if len(packet) <= self._room:
            reply(packet)
            return
        self._number += 1
        for fragment in iter_fragments(packet, self._number, self._room - AmsHeader.SIZE):
            reply(fragment)


_COMMANDS = frozenset(AmsCommand)
