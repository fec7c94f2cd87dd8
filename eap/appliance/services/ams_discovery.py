"""UDP 48899: tools that have an address ask which AMS routers are there.

Rule: an answer is hardly longer than its question, so nobody is flooded by way of us.
"""

from __future__ import annotations

import asyncio
import logging
import socket
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

from eap.appliance.discards import Refusal
from eap.codec.ads import AdsError
from eap.codec.amsdiscovery import (
    RESPONSE,
    Discovery,
    DiscoveryHeader,
    DiscoveryService,
    Tag,
    decode_discovery,
    decode_text,
    encode_discovery,
    encode_text,
)
from eap.errors import CodecError
from eap.ids import NetId

SYSTEM_PORT = 10000
"""AMS port of the system service, in whose name routers answer."""
_LONGEST = 2048
_DATAGRAMS_PER_TURN = 64

logger = logging.getLogger(__name__)


class RouterName(NamedTuple):
    """A router that can be found."""

    name: str
    """Of its station."""
    net_id: NetId


class AmsDiscovery:
    """One socket and the routers that are found by it.

    Args:
        sock: Opened by the supervisor; it stays open.
        routers: At its address.
        refuse: Counts a datagram that is not answered.
    """

    def __init__(
        self,
        sock: socket.socket,
        routers: Sequence[RouterName],
        refuse: Callable[[Refusal], None],
    ) -> None:
        sock.setblocking(False)
        self._sock = sock
        self._routers = routers
        self._refuse = refuse
        self._has_said = False

    def watch(self) -> None:
        """Answer whenever something arrives, as long as the running loop lives."""
        asyncio.get_running_loop().add_reader(self._sock.fileno(), self._drain)

    def answers_to(self, data: bytes) -> list[bytes]:
        """Return the datagrams that go back to the sender of *data*: one a router, or none."""
        try:
            question = decode_discovery(data)
        except CodecError:
            return []
        return list(self._answers(question))

    def _answers(self, question: Discovery) -> Iterator[bytes]:
        service, number = question.header.service, question.header.invoke_id
        if service == DiscoveryService.SERVER_INFO:
            for router in self._routers:
                yield _answer(router, service, number, (Tag.HOST, encode_text(router.name)))
        elif service == DiscoveryService.ADD_ROUTE:
            if not self._has_said:
                self._has_said = True  # a flood of questions is no flood of lines
                name = decode_text(question.find(Tag.ROUTE_NAME) or b"")[:80]
                logger.warning("route %r is not added: who asks is answered without", name)
            result = AdsError.SERVICE.to_bytes(4, "little")
            yield _answer(self._routers[0], service, number, (Tag.RESULT, result))

    def _drain(self) -> None:
        for _ in range(_DATAGRAMS_PER_TURN):
            try:
                data, sender = self._sock.recvfrom(_LONGEST)
            except BlockingIOError:
                return
            except OSError:
                continue  # what ICMP says of an answer that went before
            answers = self.answers_to(data)
            if not answers:
                self._refuse(Refusal.AMS_DISCOVERY)
            for answer in answers:
                try:
                    self._sock.sendto(answer, sender)
                except OSError as exc:
                    logger.debug("AMS router of %s: %s", sender[0], exc.strerror)


def _answer(router: RouterName, service: int, number: int, tag: tuple[int, bytes]) -> bytes:
    header = DiscoveryHeader(0, number, service | RESPONSE, router.net_id, SYSTEM_PORT)
    return encode_discovery(header, [tag])
