"""Control protocol by ADS: methods for clients on other hosts.

Most only read; those about the configuration of a station need the right CONFIGURE.

Each station's router has the service; its access rules have admitted a request before it comes
here.  An appliance has several stations: what concerns another one needs the permission of its
rules, too, and a list has only the stations whose rules permit it.

The cost is bounded, whatever clients do: their rate is limited, by host and in total, a status
document serves all requests of a tenth of a second, and answers that are fetched in parts are kept
for seconds, within a number of bytes.
"""

from __future__ import annotations

import asyncio
from collections import OrderedDict
from collections.abc import Awaitable, Callable, Collection, Mapping
from time import monotonic
from typing import Any, NamedTuple

from msgspec.structs import replace

from eap.ads.request import OperationOutcome, ReadWrite, encode_query
from eap.ams.access import host_of
from eap.codec.ads import AdsError, IndexGroup
from eap.codec.ams import CONTROL_PORT, AmsAnswer, AmsCommand, AmsHeader
from eap.control.by_ads import (
    CONFIGURE_METHODS,
    KEPT_S,
    MAX_REQUEST,
    READ_METHODS,
    AnswerPart,
    ControlOffset,
    PartRequest,
    unpack,
)
from eap.control.protocol import (
    ErrorCode,
    Hello,
    Request,
    decode_request,
    encode_failure,
    encode_result,
    request_id,
)
from eap.errors import CodecError, ControlError, EapError
from eap.ids import Endpoint, NetId
from eap.net.limits import Rate, SourceRateLimiter, SourceRates
from eap.services.ads.ads_service import begin_answer
from eap.services.control.audit import change_of, error_in_result
from eap.services.control.control_server import RecordChange, failure_of
from eap.services.routing.service import LocalRequest
from eap.services.routing.station_router import StationRouter
from eap.services.tasks import TaskSet

RATES = SourceRates(
    source=Rate(200, 100), known=Rate(600, 200), new=Rate(200, 50), local=Rate(600, 200)
)
"""Requests of one host, of all, of hosts that were never seen."""
STATUS_S = 0.1
"""Age up to which a status document is an answer."""
KEPT_BYTES = 32 << 20
"""Bytes of all answers that are kept for clients that fetch them in parts."""
_MAX_HOSTS = 256
_MAX_PENDING = 64
"""Requests of the group CONFIGURE that are done at once."""
AT_ONCE_S = 1.0
"""Time within which a request of the group CONFIGURE has its answer at once."""
_READ = ReadWrite(IndexGroup.CONTROL, ControlOffset.REQUEST, 0, b"")
_TABLE = ("pd_list", "routes_list")
"""Methods whose answer is a list with rows of all stations, unless they are asked for one."""


def _decode(line: bytes) -> Request:
    if len(line) > MAX_REQUEST:
        reason = f"a request by ADS has at most {MAX_REQUEST} bytes"
        raise ControlError(reason, code=ErrorCode.BAD_REQUEST)
    return decode_request(line)


class _RequestOrigin(NamedTuple):
    """Client of one request."""

    endpoint: Endpoint
    source: NetId
    source_port: int


class _KeptAnswer(NamedTuple):
    client: _RequestOrigin
    line: bytes
    until_s: float


class RemoteControl:
    """Methods of an appliance for clients by ADS.

    Args:
        call: Calls a method of the control protocol.
        routers: Of all stations.
        clock: In seconds.
        record: Writes the outcome of a change into the audit.
    """

    def __init__(
        self,
        call: Callable[[str, dict[str, Any]], Awaitable[Any]],
        routers: Mapping[str, StationRouter],
        clock: Callable[[], float] = monotonic,
        record: RecordChange | None = None,
    ) -> None:
        self._call = call
        self._routers = routers
        self._clock = clock
        self._record = record
        self._tasks = TaskSet("configuration by ADS")
        self._pending: dict[int, _RequestOrigin] = {}
        """Clients of requests that are not done yet, by ticket."""
        self._rates = SourceRateLimiter(RATES, _MAX_HOSTS, clock())
        self._status: tuple[float, dict[str, Any]] | None = None
        self._kept: OrderedDict[int, _KeptAnswer] = OrderedDict()
        self._kept_bytes = 0
        self._last_ticket = 0

    def is_admitted(self, endpoint: Endpoint) -> bool:
        """Take a request of a client; return whether the rates allow it."""
        return self._rates.take(host_of(endpoint), self._clock())

    async def answer(self, client: _RequestOrigin, station: str, line: bytes, length: int) -> bytes:
        """Return the first *length* bytes of the answer to a request, behind their head.

        Args:
            client: Its client.
            station: Station whose router admitted it.
            line: The request.
            length: Bytes that the client accepts.
        """
        number = None
        try:
            request = _decode(line)
            number = request.id
            result = await self._result(client, station, request)
            answer = encode_result(number, result)
        except Exception as exc:  # noqa: BLE001  failure_of() logs a defect
            number = request_id(line) if number is None else number
            answer = encode_failure(number, failure_of(exc))
        return self._first_part(client, answer.rstrip(b"\n"), length)

    async def configure(
        self, client: _RequestOrigin, station: str, operation: ReadWrite
    ) -> OperationOutcome:
        """Return the begin of the answer to a request of the group CONFIGURE.

        The request is done to its end, whatever becomes of the client.  An answer that takes longer
        than a moment is fetched like the rest of a long one.

        Args:
            client: Its client.
            station: Station whose router admitted it.
            operation: The request.
        """
        if len(self._pending) >= _MAX_PENDING:
            return OperationOutcome(AdsError.BUSY, why="too many configurations at once")
        self._last_ticket = ticket = self._last_ticket % 0xFFFF_FFFF + 1
        self._pending[ticket] = client
        done = self._tasks.start_awaited(self._configure(client, station, operation))

        def finish(task: asyncio.Task[bytes]) -> None:
            if self._pending.pop(ticket, None) and not task.cancelled():
                self._keep(client, task.result(), ticket)

        try:
            await asyncio.wait({done}, timeout=AT_ONCE_S)
        finally:  # its client may have gone meanwhile
            if done.done():
                del self._pending[ticket]
            else:
                done.add_done_callback(finish)
        if not done.done():
            return OperationOutcome(data=AnswerPart(ticket, 0).encode())
        return OperationOutcome(data=self._first_part(client, done.result(), operation.length))

    async def _configure(self, client: _RequestOrigin, station: str, operation: ReadWrite) -> bytes:
        """Return the answer to a request, which the audit has by then."""
        number = None
        try:
            request = decode_request(unpack(operation.data))
            number = request.id
            if CONFIGURE_METHODS.get(request.method) != operation.offset:
                reason = f"{request.method!r} is no method of offset {operation.offset}"
                raise ControlError(reason, code=ErrorCode.UNKNOWN_METHOD)  # noqa: TRY301
            named = str(request.params.get("station"))
            if named != station and named in self._routers:
                self._require(client, named, operation)
            return encode_result(number, await self._call_audited(client, request)).rstrip(b"\n")
        except Exception as exc:  # noqa: BLE001  failure_of() logs a defect
            return encode_failure(number, failure_of(exc)).rstrip(b"\n")

    async def _call_audited(self, client: _RequestOrigin, request: Request) -> Any:
        change = change_of(request, lambda _: None)
        if change is None or self._record is None:
            return await self._call(request.method, request.params)
        station, fields = change
        error: str | None = None  # as long as nobody knows
        try:
            result = await self._call(request.method, request.params)
            error = error_in_result(result)
        except EapError as exc:
            error = str(exc)
            raise
        finally:
            peer = f"{client.endpoint.transport} {host_of(client.endpoint)}, {client.source}"
            self._record(peer, station, fields | {"error": error})
        return result

    def part(self, client: _RequestOrigin, wanted: PartRequest, length: int) -> OperationOutcome:
        """Return the bytes of an answer that follow a part; the last one ends it."""
        self._drop_old()
        if self._pending.get(wanted.ticket) == client:
            return OperationOutcome(data=AnswerPart(wanted.ticket, 0).encode())
        kept = self._kept.get(wanted.ticket)
        if kept is None or kept.client != client:
            return OperationOutcome(AdsError.NOT_FOUND, why=f"no answer has ticket {wanted.ticket}")
        end = wanted.position + max(0, length - AnswerPart.SIZE)
        head = AnswerPart(wanted.ticket, len(kept.line)).encode()
        if end >= len(kept.line):
            self._drop(wanted.ticket)
        return OperationOutcome(data=head + kept.line[wanted.position : end])

    async def _result(self, client: _RequestOrigin, station: str, request: Request) -> Any:
        method, params = request.method, request.params
        if method not in READ_METHODS:
            names = ", ".join(sorted(READ_METHODS))
            reason = f"{method!r} is no method by ADS, which has {names}; write variables by ADS"
            raise ControlError(reason, code=ErrorCode.UNKNOWN_METHOD)
        named = params.get("station")
        if isinstance(named, str) and named in self._routers:
            if named != station:
                self._require(client, named)
            return await self._call(method, params)
        permitted = [name for name in self._routers if name == station or self._may(client, name)]
        if method == "status":
            return _status_of(await self._status_document(params), permitted, self._routers)
        if method in _TABLE:
            lists = [await self._call(method, params | {"station": name}) for name in permitted]
            return [row for rows in lists for row in rows]
        result = await self._call(method, params)
        return replace(result, stations=permitted) if isinstance(result, Hello) else result

    async def _status_document(self, params: dict[str, Any]) -> dict[str, Any]:
        now_s = self._clock()
        if params or self._status is None or now_s - self._status[0] > STATUS_S:
            self._status = now_s, await self._call("status", params)
        return self._status[1]

    def _require(self, client: _RequestOrigin, station: str, operation: ReadWrite = _READ) -> None:
        """Raise ControlError if the rules of another station deny the client an operation."""
        router = self._routers[station]
        header, body = _request_to(router.net_id, client, operation)
        if why := router.denial(header, body, client.endpoint):
            raise ControlError(f"station {station}: {why}", code=ErrorCode.REFUSED)

    def _may(self, client: _RequestOrigin, station: str) -> bool:
        router = self._routers[station]
        grants = router.access.grants(client.endpoint, client.source, router.net_id, CONTROL_PORT)
        return grants.decide(_READ).is_allowed

    def _first_part(self, client: _RequestOrigin, line: bytes, length: int) -> bytes:
        space = max(0, length - AnswerPart.SIZE)
        if len(line) <= space:
            return AnswerPart(0, len(line)).encode() + line
        self._last_ticket = ticket = self._last_ticket % 0xFFFF_FFFF + 1
        self._keep(client, line, ticket)
        return AnswerPart(ticket, len(line)).encode() + line[:space]

    def _keep(self, client: _RequestOrigin, line: bytes, ticket: int) -> None:
        self._drop_old()
        self._kept[ticket] = _KeptAnswer(client, line, self._clock() + KEPT_S)
        self._kept_bytes += len(line)
        while self._kept_bytes > KEPT_BYTES:
            self._drop(next(iter(self._kept)))

    def _drop_old(self) -> None:
        now_s = self._clock()
        while self._kept and (oldest := next(iter(self._kept))):
            if self._kept[oldest].until_s > now_s:
                return
            self._drop(oldest)

    def _drop(self, ticket: int) -> None:
        self._kept_bytes -= len(self._kept.pop(ticket).line)


class ControlAds:
    """Service of the control protocol at one station's router (Service).

    Args:
        station: Name of the station.
        control: The methods of the appliance.
    """

    ports = frozenset((CONTROL_PORT,))

    def __init__(self, station: str, control: RemoteControl) -> None:
        self._station = station
        self._control = control

    def answer(self, request: LocalRequest) -> AmsAnswer | Awaitable[AmsAnswer]:
        """Answer a request; one beyond the rates of its host gets the error MAILBOX_FULL."""
        header = request.header
        if not self._control.is_admitted(request.endpoint):
            return AmsAnswer(error_code=AdsError.MAILBOX_FULL)
        client = _RequestOrigin(request.endpoint, header.source, header.source_port)

        def perform(operation: object) -> OperationOutcome | Awaitable[OperationOutcome]:
            if isinstance(operation, ReadWrite) and operation.group == IndexGroup.CONFIGURE:
                return self._control.configure(client, self._station, operation)
            if not isinstance(operation, ReadWrite) or operation.group != IndexGroup.CONTROL:
                return OperationOutcome(AdsError.INDEX_GROUP)
            if operation.offset == ControlOffset.REQUEST:
                return self._answer(client, operation)
            if operation.offset == ControlOffset.PART:
                try:
                    wanted = PartRequest.decode(operation.data)
                except CodecError:
                    return OperationOutcome(AdsError.SIZE)
                return self._control.part(client, wanted, operation.length)
            return OperationOutcome(AdsError.INDEX_OFFSET)

        return begin_answer(header.command, request.body, perform)

    def client_gone(self, endpoint: Endpoint) -> None:
        """Do nothing: answers that are kept end by time (Service)."""

    async def _answer(self, client: _RequestOrigin, operation: ReadWrite) -> OperationOutcome:
        answer = await self._control.answer(client, self._station, operation.data, operation.length)
        return OperationOutcome(data=answer)


def _request_to(
    target: NetId, client: _RequestOrigin, operation: ReadWrite
) -> tuple[AmsHeader, bytes]:
    command, body = encode_query(operation)
    header = AmsHeader(target, CONTROL_PORT, client.source, client.source_port, AmsCommand(command))
    return header, body


def _status_of(
    document: dict[str, Any], permitted: Collection[str], stations: Collection[str]
) -> dict[str, Any]:
    """Return a status document with the *permitted* ones of an appliance's stations."""
    if len(permitted) == len(stations):
        return document
    hidden = [name for name in stations if name not in permitted]
    return document | {
        "stations": [each for each in document["stations"] if each["name"] in permitted],
        "findings": [
            each
            for each in document["findings"]
            if not any(_is_about(each["where"], name) for name in hidden)
        ],
    }


def _is_about(where: str, station: str) -> bool:
    """Return whether the location of a finding is in a station."""
    return where == station or where.startswith((f"{station}/", f"{station} "))
