"""Control protocol by ADS: a connection to the appliance of another host, by AMS/TCP.

Requests that only read go to the control service of a station's router; variables are written as
by any ADS client, so that the access rules of the station apply to them, and its audit.
"""

from __future__ import annotations

import asyncio
import os
import socket
import time
from collections.abc import AsyncGenerator
from contextlib import suppress
from ipaddress import IPv4Address
from itertools import count
from secrets import randbelow
from typing import Any, NamedTuple, Self

from msgspec.structs import asdict

from eap.ads.request import Operation, ReadWrite, Write, decode_outcome, encode_query
from eap.ads.symboltypes import symbol_type
from eap.codec import datatypes
from eap.codec.ads import AdsError, IndexGroup
from eap.codec.adssymbol import SymbolAddress
from eap.codec.ams import (
    AMS_TCP_PORT,
    CONTROL_PORT,
    DEVICE_PORT,
    AmsAnswer,
    AmsHeader,
    AmsTcpHeader,
    StateFlags,
    decode_packet,
    decode_prefix,
    encode_packet,
)
from eap.codec.amsdiscovery import (
    AMS_UDP_PORT,
    COOKIE,
    RESPONSE,
    DiscoveryHeader,
    DiscoveryService,
    decode_discovery,
    encode_discovery,
)
from eap.codec.datatypes import find_variable
from eap.control.by_ads import (
    CONFIGURE_METHODS,
    PART,
    AnswerPart,
    ControlOffset,
    PartRequest,
    pack,
)
from eap.control.protocol import (
    READ,
    VARIABLES,
    ErrorCode,
    ValuesEvent,
    WriteParameters,
    Written,
    decode_reply,
    encode_request,
    parameters,
)
from eap.errors import CodecError, ControlError
from eap.ids import NetId
from eap.live.transport import NumberedConnection, ValuesSubscription, gone
from eap.ops.client import checked

CONNECT_S = 3.0
"""Time for a connection."""
ANSWER_S = 5.0
"""Time for the answer of a router."""
CONFIGURE_S = 60.0
"""Time for a request about the configuration of a station."""
_CONFIGURE_PAUSE_S = 0.1
_DISCOVERY_TRIES = 3
_DISCOVERY_S = 0.5
_FIRST_PORT = 0x8000
"""First source port, in the range that AMS routers give to clients."""
_NET_ID_NUMBERS = 6
_MAX_PACKET = 1 << 20


class RemoteHost(NamedTuple):
    """Station of another host: the address of a router, and the NetID of the station."""

    host: str
    net_id: NetId | None = None
    """None for that of the router at *host*."""

    @classmethod
    def parse(cls, text: str) -> Self:
        """Read ``HOST[:NETID]``; raise ValueError if it is something else."""
        host, colon, net_id = text.partition(":")
        if not host or host.count(".") == _NET_ID_NUMBERS - 1 or (colon and not net_id):
            raise ValueError(f"{text!r} is not HOST or HOST:NETID, such as 10.0.0.5")
        return cls(host, NetId.parse(net_id) if net_id else None)

    def __str__(self) -> str:
        return self.host if self.net_id is None else f"{self.host}:{self.net_id}"


class AdsConnection(NumberedConnection[AmsAnswer]):
    """The appliance of a remote station (PlantConnection).

    Args:
        reader: Of a connection to a router.
        writer: Of the same.
        target: NetID of the station.
        source: NetID of this client; answers come by the connection, whatever it is.
    """

    def __init__(
        self,
        reader: asyncio.StreamReader,
        writer: asyncio.StreamWriter,
        target: NetId,
        source: NetId,
    ) -> None:
        super().__init__(reader, writer, "ADS connection")
        self._target = target
        self._source = source
        # All clients of this host have one NetID: a router tells them apart by their ports.
        self._source_port = _FIRST_PORT + randbelow(_FIRST_PORT)
        self._numbers = count(1)
        self._ports: dict[str, NetId] = {}

    @classmethod
    async def open(cls, address: RemoteHost) -> Self:
        """Connect to the router of *address*.

        Raises:
            ControlError: it cannot be reached, or has no AMS router.
        """
        host = await _resolve(address.host)
        target = address.net_id or await find_net_id(host)
        try:
            async with asyncio.timeout(CONNECT_S):
                reader, writer = await asyncio.open_connection(host, AMS_TCP_PORT)
        except (OSError, TimeoutError) as exc:
            # The text of asyncio repeats the address.
            number = getattr(exc, "errno", None)
            why = os.strerror(number) if number else "it does not answer"
            raise gone(f"{address.host} cannot be reached at port {AMS_TCP_PORT}: {why}") from None
        # Answers come by this connection: the router needs no route to this NetID.
        own = IPv4Address(writer.get_extra_info("sockname")[0])
        return cls(reader, writer, target, NetId(own.packed + b"\1\1"))

    async def request(self, method: str, params: dict[str, Any]) -> Any:
        """Return the result of a method by ADS, or of ``write``.

        Raises:
            ControlError: the appliance or a router on the way refused or does not answer.
        """
        if method == "write":
            return await self._write(parameters(params, WriteParameters))
        # AMS has invoke IDs of its own, so that one number does for all lines.
        line = encode_request(1, method, params).rstrip(b"\n")
        configures = CONFIGURE_METHODS.get(method)
        if configures is not None:
            operation = ReadWrite(IndexGroup.CONFIGURE, configures, PART, pack(line))
        else:
            operation = ReadWrite(IndexGroup.CONTROL, ControlOffset.REQUEST, PART, line)
        answer, head = await self._part(operation)
        # A change of the configuration takes longer than routers wait for an answer: it is begun by
        # one request, and others ask for its answer.
        deadline_s = asyncio.get_running_loop().time() + CONFIGURE_S
        while not head.total:
            if asyncio.get_running_loop().time() > deadline_s:
                raise gone(f"{method} is not done after {CONFIGURE_S:g} s")
            await asyncio.sleep(_CONFIGURE_PAUSE_S)
            answer, head = await self._rest(head.ticket, 0)
        while len(answer) < head.total:
            more, head = await self._rest(head.ticket, len(answer))
            # A router that answers with nothing would be asked for ever.
            if not more:
                raise gone("the appliance answered with less than it announced")
            answer += more
        return checked(decode_reply(answer)).result

    async def watch(self, wanted: ValuesSubscription) -> AsyncGenerator[ValuesEvent | ControlError]:
        """Yield the values of variables, read once a period, until the connection ends."""
        last: dict[str, Any] = {}
        last_cycle: int | None = None
        clock = asyncio.get_running_loop().time
        due_s = clock()
        while True:
            try:
                names = {"station": wanted.station, "names": wanted.names}
                found = READ.decode(await self.request(READ.name, names))
            except ControlError as exc:
                if exc.code == ErrorCode.UNAVAILABLE and self._error is not None:
                    raise
                yield exc
            else:
                values = found.values
                if wanted.only_changes:
                    values = {n: v for n, v in values.items() if n not in last or last[n] != v}
                    last = found.values
                skipped = 0 if last_cycle is None else max(found.cycle - last_cycle - 1, 0)
                last_cycle = found.cycle
                if values:
                    changed = {
                        "values": values,
                        "quality": {n: q for n, q in found.quality.items() if n in values},
                        "stale": tuple(n for n in found.stale if n in values),
                    }
                    yield ValuesEvent(**asdict(found) | changed, skipped=skipped)
            due_s = max(due_s + wanted.period_ms / 1000, clock())
            await asyncio.sleep(due_s - clock())

    async def _rest(self, ticket: int, position: int) -> tuple[bytes, AnswerPart]:
        wanted = PartRequest(ticket, position).encode()
        return await self._part(ReadWrite(IndexGroup.CONTROL, ControlOffset.PART, PART, wanted))

    async def _part(self, operation: ReadWrite) -> tuple[bytes, AnswerPart]:
        answer = await self._ask(self._target, CONTROL_PORT, operation)
        try:
            return answer[AnswerPart.SIZE :], AnswerPart.decode(answer)
        except CodecError:
            raise gone("what answers there is no appliance of this release") from None

    async def _write(self, wanted: WriteParameters) -> Written:
        """Write variables one after the other, when all values have been checked."""
        rows = VARIABLES.decode(await self.request(VARIABLES.name, {"station": wanted.station}))
        kinds = {row.name: datatypes.parse(row.type) for row in rows}
        octets: dict[str, bytes] = {}
        for name, value in wanted.values.items():
            found = find_variable(name, kinds.get)
            if found is None:
                reason = f"station {wanted.station} has no variable {name!r}"
                raise ControlError(reason, code=ErrorCode.UNKNOWN_NAME)
            kind = found[1].kind
            try:
                octets[name] = symbol_type(kind).to_client(kind.encode(kind.from_plain(value)))
            except ValueError as exc:
                raise ControlError(f"variable {name}: {exc}", code=ErrorCode.VALUE) from None
        port = await self._port(wanted.station)
        for name, data in octets.items():
            # A symbol may have moved since the last write: the plant is changed while it runs.
            lookup = ReadWrite(
                IndexGroup.SYMBOL_BY_NAME, 0, SymbolAddress.SIZE, name.encode() + b"\0"
            )
            at = SymbolAddress.decode(await self._ask(port, DEVICE_PORT, lookup))
            await self._ask(port, DEVICE_PORT, Write(at.group, at.offset, data), what=name)
        return Written(len(octets))

    async def _port(self, station: str) -> NetId:
        """Return the NetID of an EAP port of a station, which has its variables."""
        if station not in self._ports:
            document = await self.request("status", {})
            for each in document["stations"]:
                # Reversed, so that the first of several ports stays.
                for port in reversed(each["ports"]):
                    if port["kind"] == "eap":
                        self._ports[each["name"]] = NetId.parse(port["net_id"])
        try:
            return self._ports[station]
        except KeyError:
            reason = f"station {station} has no EAP port, by which variables are written"
            raise ControlError(reason, code=ErrorCode.UNKNOWN_NAME) from None

    async def _ask(self, target: NetId, port: int, operation: Operation, what: str = "") -> bytes:
        """Return the data of the answer to an operation."""
        if self._error is not None:
            raise self._error
        number = next(self._numbers) & 0xFFFF_FFFF
        answer: asyncio.Future[AmsAnswer] = asyncio.get_running_loop().create_future()
        self._waiting[number] = answer
        command, body = encode_query(operation)
        header = AmsHeader(
            target, port, self._source, self._source_port, command, StateFlags.ADS,
            invoke_id=number,
        )  # fmt: skip
        packet = encode_packet(header, body)
        try:
            self._writer.write(AmsTcpHeader(length=len(packet)).encode() + packet)
            async with asyncio.timeout(ANSWER_S):
                await self._writer.drain()
                found = await answer
        except (OSError, TimeoutError):
            raise gone(f"station {target} does not answer within {ANSWER_S:g} s") from None
        finally:
            del self._waiting[number]
        outcome = decode_outcome(command, found.error_code, found.data)
        if outcome.result:
            raise _refused(outcome.result, what or str(target))
        return outcome.data

    async def _receive(self) -> None:
        why = "the router closed the connection"
        try:
            while True:
                prefix = await self._reader.readexactly(AmsTcpHeader.SIZE)
                header, body = decode_packet(await self._reader.readexactly(decode_prefix(prefix)))
                # An answer that comes after its time-out has no waiter any more.
                answer = self._waiting.get(header.invoke_id)
                if answer is not None and not answer.done():
                    answer.set_result(AmsAnswer(bytes(body), header.error_code))
        except asyncio.IncompleteReadError:
            pass
        except (OSError, CodecError) as exc:
            why = f"the connection to the router broke: {exc}"
        self._end(why)


def _refused(result: int, what: str) -> ControlError:
    """Return the error of a request that a router or a service refused."""
    words = f"{what}: {AdsError.words_of(result)}"
    match result:
        case AdsError.ACCESS_DENIED | AdsError.ACCESS:
            return ControlError(words, code=ErrorCode.REFUSED)
        case AdsError.TARGET_PORT:
            text = f"{words}: no appliance of this release, which has the control protocol by ADS"
            return gone(text)
        case AdsError.MAILBOX_FULL | AdsError.BUSY:
            return ControlError(words, code=ErrorCode.BUSY)
        case AdsError.VALUE | AdsError.SIZE:
            return ControlError(words, code=ErrorCode.VALUE)
    return gone(words)


async def _resolve(host: str) -> str:
    """Return the IPv4 address of a host name."""
    loop = asyncio.get_running_loop()
    try:
        found = await loop.getaddrinfo(host, AMS_TCP_PORT, family=socket.AF_INET)
    except OSError as exc:
        raise gone(f"{host}: no such host: {exc.strerror}") from None
    return str(found[0][4][0])


async def find_net_id(host: str) -> NetId:
    """Return the NetID of the AMS router at an IPv4 address, by UDP 48899.

    Raises:
        ControlError: no router answers.
    """
    loop = asyncio.get_running_loop()
    number = time.monotonic_ns() & 0xFFFF_FFFF
    header = DiscoveryHeader(COOKIE, number, DiscoveryService.SERVER_INFO, NetId(bytes(6)), 0)
    query = encode_discovery(header)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.setblocking(False)
        # Connected: only answers of this host arrive, and an ICMP error ends the wait.
        sock.connect((host, AMS_UDP_PORT))
        for _ in range(_DISCOVERY_TRIES):
            with suppress(OSError, CodecError, TimeoutError):
                await loop.sock_sendall(sock, query)
                async with asyncio.timeout(_DISCOVERY_S):
                    answer = decode_discovery(await loop.sock_recv(sock, 2048)).header
                if answer.invoke_id == number and answer.service & RESPONSE:
                    return answer.net_id
    raise gone(
        f"{host}: no AMS router answers at UDP {AMS_UDP_PORT}: check host and firewall, or name its"
        f" NetID as {host}:NETID"
    )
