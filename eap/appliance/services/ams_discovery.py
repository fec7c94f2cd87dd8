"""UDP 48899: tools that have an address ask which AMS routers are there, and for routes to them.

Rule: an answer is hardly longer than its question, so nobody is flooded by way of us.  Hence who
asks for routers is told name and version; what routers of others tell beside that (the operating
system, a fingerprint) is ten times as long, and no tool we know needs it.
"""

from __future__ import annotations

import asyncio
import logging
import secrets
import socket
from collections.abc import Callable, Iterator, Sequence
from importlib.metadata import version
from ipaddress import IPv4Address
from typing import NamedTuple

from eap.appliance.discards import Refusal
from eap.appliance.services.neighbours import Neighbour
from eap.appliance.services.route_desk import RouteDesk
from eap.codec.amsdiscovery import (
    AMS_UDP_PORT,
    RESPONSE,
    Discovery,
    DiscoveryHeader,
    DiscoveryService,
    Tag,
    decode_discovery,
    decode_text,
    decode_version,
    encode_discovery,
    encode_text,
    encode_version,
)
from eap.errors import CodecError, EnvironmentalError
from eap.ids import NetId
from eap.net.interface import broadcast_of

SYSTEM_PORT = 10000
"""AMS port of the system service, in whose name routers answer."""
SCAN_S = 1.0
"""How long routers may take to answer."""
MAX_NEIGHBOURS = 1024
"""Answers to one question that are taken."""
BROADCAST = "255.255.255.255"
_MAX_NAME = 80
_VERSION = encode_version(version("eap-appliance"))
_LONGEST = 2048
_DATAGRAMS_PER_TURN = 64

logger = logging.getLogger(__name__)


class RouterName(NamedTuple):
    """A router that can be found."""

    name: str
    """Of its station."""
    net_id: NetId


class AmsDiscovery:
    """The routers that are found at one address, and the question of who else is there.

    Args:
        sock: Opened by the supervisor for datagrams to that address; answers go out by it.  It
            stays open.
        routers: At that address.
        desk: Decides on routes.
        refuse: Counts a datagram that is not answered.
    """

    def __init__(
        self,
        sock: socket.socket,
        routers: Sequence[RouterName],
        desk: RouteDesk,
        refuse: Callable[[Refusal], None],
    ) -> None:
        self._sock = sock
        self._own = sock.getsockname()[0]
        self._routers = routers
        self._desk = desk
        self._refuse = refuse
        self._scans: dict[int, dict[NetId, Neighbour]] = {}

    async def scan(
        self, address: str = "", *, wait_s: float = SCAN_S, port: int = AMS_UDP_PORT
    ) -> list[Neighbour]:
        """Ask who is there, and return who answered in time.

        Args:
            address: Of a host or a network; the network of this address if empty.
            wait_s: How long to wait for answers.
            port: UDP port of the routers.

        Raises:
            EnvironmentalError: the question cannot be sent.
        """
        number = secrets.randbits(32) or 1
        found: dict[NetId, Neighbour] = {}
        self._scans[number] = found
        header = DiscoveryHeader(
            0, number, DiscoveryService.SERVER_INFO, self._routers[0].net_id, SYSTEM_PORT
        )
        target = address or network_of(self._own)
        try:
            self._sock.sendto(encode_discovery(header), (target, port))
            await asyncio.sleep(wait_s)
        except OSError as exc:
            reason = f"{target} cannot be asked from {self._own}: {exc.strerror or exc}"
            raise EnvironmentalError(reason) from None
        finally:
            del self._scans[number]
        return list(found.values())

    def watch(self, sock: socket.socket | None = None) -> None:
        """Answer whenever something arrives, as long as the running loop lives.

        With *sock* what arrives there: broadcasts to the network of the address.
        """
        watched = self._sock if sock is None else sock
        watched.setblocking(False)
        asyncio.get_running_loop().add_reader(watched.fileno(), self._drain, watched)

    def answers_to(self, data: bytes, sender: str) -> list[bytes]:
        """Return the datagrams that go back to the *sender* of *data*: one a router, or none."""
        try:
            question = decode_discovery(data)
        except CodecError:
            return []
        return list(self._answers(question, sender))

    def _answers(self, question: Discovery, sender: str) -> Iterator[bytes]:
        service, number = question.header.service, question.header.invoke_id
        if service == DiscoveryService.SERVER_INFO:
            for router in self._routers:
                # The name first: there are tools that look at no number of a tag.
                name = Tag.HOST, encode_text(router.name)
                yield _answer(router, service, number, [name, (Tag.VERSION, _VERSION)])
        elif service == DiscoveryService.ADD_ROUTE:
            is_this_host = sender == self._own or IPv4Address(sender).is_loopback
            result = self._desk.take(question, sender, is_this_host=is_this_host)
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
            if self._scans and self.take_answer(data, sender[0]):
                continue
            answers = self.answers_to(data, sender[0])
            if not answers:
                self._refuse(Refusal.AMS_DISCOVERY)
            for answer in answers:
                try:
                    self._sock.sendto(answer, sender)
                except OSError as exc:
                    logger.debug("AMS router of %s: %s", sender[0], exc.strerror)

    def take_answer(self, data: bytes, sender: str) -> bool:
        """Take *data* for an answer to a question of who is there; tell whether it is one."""
        try:
            answer = decode_discovery(data)
        except CodecError:
            return False
        found = self._scans.get(answer.header.invoke_id)
        if found is None or answer.header.service != DiscoveryService.SERVER_INFO | RESPONSE:
            return False
        net_id = answer.header.net_id
        is_new = any(net_id) and net_id not in {router.net_id for router in self._routers}
        if is_new and len(found) < MAX_NEIGHBOURS:
            name = "".join(filter(str.isprintable, decode_text(answer.find(Tag.HOST) or b"")))
            version_text = decode_version(answer.find(Tag.VERSION) or b"")
            neighbour = Neighbour(name[:_MAX_NAME], net_id, sender, version_text)
            found.setdefault(net_id, neighbour)  # who answers for somebody else comes later
        return True


def network_of(address: str) -> str:
    """Return where all hosts beside *address* of this machine are asked."""
    is_any = IPv4Address(address).is_unspecified  # whatever network is there then
    return BROADCAST if is_any else broadcast_of(address) or BROADCAST


def _answer(
    router: RouterName, service: int, number: int, tags: Sequence[tuple[int, bytes]]
) -> bytes:
    header = DiscoveryHeader(0, number, service | RESPONSE, router.net_id, SYSTEM_PORT)
    return encode_discovery(header, tags)
