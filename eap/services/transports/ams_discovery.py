"""UDP 48899: tools that have an address ask which AMS routers are there, and for routes to them.

Rule: an answer is hardly longer than its question, so nobody is flooded by way of us.  Hence who
asks for routers is told name and version; what routers of others tell beside that (the operating
system, a fingerprint) is ten times as long, and no tool we know needs it.
"""

from __future__ import annotations

import asyncio
import logging
import socket
from collections.abc import AsyncIterator, Callable, Sequence
from ipaddress import IPv4Address
from typing import NamedTuple

from eap.codec.ams import SYSTEM_PORT
from eap.codec.amsdiscovery import (
    RESPONSE,
    Discovery,
    DiscoveryHeader,
    DiscoveryService,
    Tag,
    decode_discovery,
    encode_discovery,
    encode_text,
    encode_version,
)
from eap.errors import CodecError
from eap.ids import NetId
from eap.release import RELEASE
from eap.runtime.discards import Refusal
from eap.services.routing.ams_requests import AmsQuestions
from eap.services.routing.route_admin import RouteAdmin
from eap.services.tasks import TaskSet

_VERSION = encode_version(RELEASE)
_LONGEST = 2048
_DATAGRAMS_PER_TURN = 64

logger = logging.getLogger(__name__)


class RouterName(NamedTuple):
    """A router that can be found."""

    name: str
    """Of its station."""
    net_id: NetId


class AmsDiscovery:
    """The routers that are found at one address.

    Args:
        sock: Opened by the supervisor for datagrams to that address; answers go out by it.  It
            stays open.
        routers: At that address.
        desk: Decides on routes.
        questions: That were asked by *sock*, for their answers come there too.
        refuse: Counts a datagram that is not answered.
    """

    def __init__(
        self,
        sock: socket.socket,
        routers: Sequence[RouterName],
        desk: RouteAdmin,
        questions: AmsQuestions,
        refuse: Callable[[Refusal], None],
    ) -> None:
        self._sock = sock
        self._own = sock.getsockname()[0]
        self._routers = routers
        self._route_admin = desk
        self._questions = questions
        self._refuse = refuse
        self._tasks = TaskSet("AMS discovery")

    def watch(self, sock: socket.socket | None = None) -> None:
        """Answer whenever something arrives, as long as the running loop lives.

        With *sock* what arrives there: broadcasts to the network of the address.
        """
        watched = self._sock if sock is None else sock
        watched.setblocking(False)
        asyncio.get_running_loop().add_reader(watched.fileno(), self._drain, watched)

    async def answers_to(self, data: bytes, sender: str) -> list[bytes]:
        """Return the datagrams that go back to the *sender* of *data*: one a router, or none."""
        try:
            question = decode_discovery(data)
        except CodecError:
            return []
        return [each async for each in self._answers(question, sender)]

    async def _answers(self, question: Discovery, sender: str) -> AsyncIterator[bytes]:
        service, number = question.header.service, question.header.invoke_id
        if service == DiscoveryService.SERVER_INFO:
            for router in self._routers:
                # The name first: there are tools that look at no number of a tag.
                name = Tag.HOST, encode_text(router.name)
                yield _answer(router, service, number, [name, (Tag.VERSION, _VERSION)])
        elif service == DiscoveryService.ADD_ROUTE:
            is_this_host = sender == self._own or IPv4Address(sender).is_loopback
            result = await self._route_admin.take(question, sender, is_this_host=is_this_host)
            if result is not None:
                tag = Tag.RESULT, result.to_bytes(4, "little")
                yield _answer(self._routers[0], service, number, [tag])

    def _drain(self, sock: socket.socket) -> None:
        for _ in range(_DATAGRAMS_PER_TURN):
            try:
                data, sender = sock.recvfrom(_LONGEST)
            except BlockingIOError:
                return
            except OSError:
                continue  # what ICMP says of an answer that went before
            if self._questions.take(data, sender[0]):
                continue
            self._tasks.start(self._answer(data, sender))

    async def _answer(self, data: bytes, sender: tuple[str, int]) -> None:
        answers = await self.answers_to(data, sender[0])
        if not answers:
            self._refuse(Refusal.AMS_DISCOVERY)
        for answer in answers:
            try:
                self._sock.sendto(answer, sender)
            except OSError as exc:
                logger.debug("AMS router of %s: %s", sender[0], exc.strerror)


def _answer(
    router: RouterName, service: int, number: int, tags: Sequence[tuple[int, bytes]]
) -> bytes:
    header = DiscoveryHeader(0, number, service | RESPONSE, router.net_id, SYSTEM_PORT)
    return encode_discovery(header, tags)
