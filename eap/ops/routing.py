"""ADS requests through the routers of running appliances: trace, scan, devices reached by ADS."""

from __future__ import annotations

import codecs
import re
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from threading import Event
from typing import NamedTuple, Self, TypeVar

import msgspec

from devicebus.wire.alstatus import state_name
from eap.ads.request import (
    Operation,
    OperationOutcome,
    ReadState,
    WriteControl,
    decode_outcome,
    encode_query,
)
from eap.ads.space import BOOT, INIT, OP, PREOP, SAFEOP, states_of
from eap.codec.ads import AdsError, AdsStates
from eap.control.device import StateAnswer, StateError
from eap.control.protocol import Document, ErrorCode
from eap.control.routes import (
    AMS_ASK,
    ROUTES_LIST,
    SCAN,
    TRACE,
    PlantScan,
    RouterRow,
    TestResult,
    TracedPath,
)
from eap.errors import CodecError, ControlError
from eap.gateway.error_table import cause_of_result
from eap.ops.client import ControlClient, call_each, connect

T = TypeVar("T")

TRACE_S = 60.0
SCAN_S = 120.0
"""Time for a scan: each station that does not answer takes its time-out."""
_ON_THE_WAY = frozenset((AdsError.TARGET_MACHINE, AdsError.HOST_UNREACHABLE, AdsError.TIMEOUT))
"""Errors of routers between here and the device."""
_NUMBERS = {"INIT": INIT, "PREOP": PREOP, "BOOT": BOOT, "SAFEOP": SAFEOP, "OP": OP}
STATE_S = 10.0
_PAUSE_S = 0.1


def trace(target: str, plant: str | None = None, via: str | None = None) -> TracedPath:
    """Return the path to *target*, hop by hop.

    Args:
        target: ``STATION[/PORT[/SLAVE]]`` or ``NETID[:PORT]``.
        plant: Of the appliance that sends; None for the first that knows the target.
        via: Station whose router sends the requests; None for the first of the appliance.

    Raises:
        ControlError: there is no such target or station, or no appliance answers.
    """

    def query(client: ControlClient) -> TracedPath:
        return client.call(TRACE, within_s=TRACE_S, via=via or "", target=target)

    with first_answer(query, plant, via) as (_, answer):
        return answer


def scan(plant: str | None = None, via: str | None = None) -> list[PlantScan]:
    """Return one answer for each plant that runs here.

    Raises:
        ControlError: nothing runs, or it does not answer.
    """
    answers: dict[str, PlantScan] = {}
    with ExitStack() as stack:
        for client in [stack.enter_context(each) for each in connect(plant, via)]:
            # Several appliances may run parts of one plant; each knows the whole of it.
            if client.info.plant not in answers:
                answers[client.info.plant] = client.call(SCAN, within_s=SCAN_S, via=via or "")
    return list(answers.values())


@contextmanager
def first_answer(
    query: Callable[[ControlClient], T], plant: str | None, via: str | None = None
) -> Iterator[tuple[ControlClient, T]]:
    """Query the appliances in turn; return the first that knows the names, and its answer.

    Args:
        query: Query of one appliance; raises ControlError if a name is unknown.
        plant: Of the appliance; None for any.
        via: Station that has to run there; None for any.

    Raises:
        ControlError: nothing runs, the names are unknown, or *query* failed in another way.
    """
    unknown: ControlError | None = None
    silent: ControlError | None = None
    with ExitStack() as stack:
        for client in [stack.enter_context(each) for each in connect(plant, via)]:
            try:
                answer = query(client)
            except ControlError as exc:
                # Another appliance may know the name, or have a route to it.
                if exc.code == ErrorCode.UNAVAILABLE:
                    silent = silent or exc
                elif exc.code == ErrorCode.UNKNOWN_NAME:
                    unknown = unknown or exc
                else:
                    raise
            else:
                yield client, answer
                return
    error = silent or unknown
    assert error is not None  # noqa: S101  connect() found at least one
    raise error


class AmsRefusedError(ControlError):
    """The device refuses, or cannot be reached; *result* is that of ADS."""

    def __init__(self, message: str, result: int) -> None:
        super().__init__(message, code=ErrorCode.REFUSED)
        self.result = result


class AmsDevice:
    """One device; *target* is ``STATION[/PORT[/SLAVE]]`` or ``NETID[:PORT]``."""

    def __init__(self, client: ControlClient, target: str) -> None:
        self.target = target
        self._client = client

    def send(self, operation: Operation) -> OperationOutcome:
        """Return the result of one operation; raise ControlError if there is no such target."""
        command, body = encode_query(operation)
        answer = self._client.call(
            AMS_ASK, target=self.target, command=command, data=body.hex(), device=True
        )
        return decode_outcome(command, answer.error, bytes.fromhex(answer.data))

    def demand(self, operation: Operation, what: str) -> bytes:
        """Return the data of an answer.

        Args:
            operation: The request.
            what: That, in words.

        Raises:
            AmsRefusedError: the device refuses, or cannot be reached.
        """
        outcome = self.send(operation)
        if outcome.result:
            raise self.refusal(outcome.result, what)
        return outcome.data

    def refusal(self, result: int, what: str) -> AmsRefusedError:
        """Return the exception for a result of ADS."""
        if result in _ON_THE_WAY and (why := self._find_fault()):
            return AmsRefusedError(f"{self.target}: {what}: {why}", result)
        cause = cause_of_result(result)
        if cause.is_from_slave and cause.ads == result:
            text = f"{cause.text} (error 0x{result:x})"
        else:
            text = f"{AdsError.words_of(result)}; 'eapctl trace {self.target}' shows where"
        return AmsRefusedError(f"{self.target}: {what}: {text}", result)

    def _find_fault(self) -> str:
        """Return the router at which the path to the device ends and the cause, or ""."""
        try:
            return self._client.call(TRACE, target=self.target).why
        except ControlError:
            return ""


@contextmanager
def open_ams(target: str, plant: str | None) -> Iterator[AmsDevice]:
    """Reach *target* through the first appliance that knows it.

    Raises:
        ControlError: nothing runs, or the target is not known.
    """
    with first_answer(lambda each: AmsDevice(each, target).send(ReadState()), plant) as found:
        client, _ = found
        yield AmsDevice(client, target)


def read_state(device: AmsDevice) -> StateAnswer:
    """Return the state of a device; raises as AmsDevice.demand."""
    return StateAnswer(_now(device), None)


def request_state(
    device: AmsDevice,
    wanted: str,
    *,
    clock: Callable[[], float] = time.monotonic,
    pause: Callable[[float], object] | None = None,
) -> StateAnswer:
    """Bring a device to another state, and wait for it.

    Args:
        device: Which.
        wanted: ``INIT``, ``PREOP``, ``BOOT``, ``SAFEOP`` or ``OP``.
        clock: In seconds.
        pause: Lets seconds pass; None really does.

    Raises:
        AmsRefusedError: the device cannot be reached.
    """
    number = _NUMBERS[wanted]
    pause = pause or Event().wait
    outcome = device.send(WriteControl(states_of(number).ads_state, number, b""))
    if outcome.result == AdsError.ACCESS_DENIED:
        raise device.refusal(outcome.result, wanted)
    now = _now(device)
    # A refused request is not waited for; the state is read once, as the device may be there
    # already.
    deadline = clock() + (0 if outcome.result else STATE_S)
    while now != wanted and clock() < deadline:
        pause(_PAUSE_S)
        now = _now(device)
    if now == wanted:
        return StateAnswer(now, None)
    if outcome.result:
        error = StateError(outcome.result, AdsError.words_of(outcome.result))
    else:
        error = StateError(0, f"not there within {STATE_S:g} s")
    return StateAnswer(now, error)


def _now(device: AmsDevice) -> str:
    data = device.demand(ReadState(), "state")
    try:
        return state_name(AdsStates.decode(data).device_state)
    except CodecError as exc:
        raise ControlError(f"{device.target}: state: {exc}") from None


_DECLARED = re.compile(rb"""<\?xml[^>]*\sencoding\s*=\s*["']([A-Za-z0-9._-]+)["']""")
_MARKS = (
    (codecs.BOM_UTF8, "utf-8-sig"),
    (codecs.BOM_UTF16_LE, "utf-16"),
    (codecs.BOM_UTF16_BE, "utf-16"),
)


class RouterList(msgspec.Struct, frozen=True):
    """``eapctl routes list``."""

    stations: list[RouterRow]


class TestedTarget(Document, frozen=True, kw_only=True):
    """``eapctl routes test``: station that tested a target, and the fields of a TestResult."""

    __test__ = False

    station: str
    target: str
    name: str
    ok: bool
    rtt_us: int | None
    state: str
    error: int
    text: str
    hint: str

    @classmethod
    def of(cls, station: str, result: TestResult) -> Self:
        """Return the *result* of a test by *station*."""
        return cls(station=station, **msgspec.structs.asdict(result))


class PlantRoutes(NamedTuple):
    """The routers of one running appliance."""

    plant: str
    stations: list[RouterRow]


def list_routes(
    plant: str | None,
    station: str | None,
    match: str = "",
    *,
    requests: int = 0,
    most: int | None = None,
    silent: list[ControlError] | None = None,
) -> list[PlantRoutes]:
    """Return all routes of the running stations, or of *station*, that *match*.

    Args:
        plant: Of the appliance; None for all.
        station: Its name; None for all.
        match: Substring of name, NetID, transport, address, origin or state of a route.
        requests: Number of the latest requests to return of each station.
        most: Routes of one station; None for as many as there are.
        silent: Gets the errors of appliances that do not answer, if others do.

    Raises:
        ControlError: there is no such appliance or station, or it does not answer.
    """
    with ExitStack() as stack:
        clients = [stack.enter_context(each) for each in connect(plant, station)]
        found, errors = call_each(
            clients,
            lambda each: PlantRoutes(
                each.info.plant, _fetch_routes(each, station or "", match, requests, most)
            ),
        )
    if silent is not None:
        silent += errors
    elif errors:
        raise errors[0]
    return found


def _fetch_routes(
    client: ControlClient, station: str, match: str, requests: int, most: int | None
) -> list[RouterRow]:
    """Return the routes of one appliance, page by page."""
    whole = []
    for each in client.call(ROUTES_LIST, station=station, match=match, requests=requests):
        rows = list(each.routes)
        while len(rows) < (each.total if most is None else min(most, each.total)):
            (more,) = client.call(
                ROUTES_LIST, station=each.station, match=match, first=len(rows), requests=0
            )
            if not more.routes:  # some went away meanwhile
                break
            rows += more.routes
        whole.append(msgspec.structs.replace(each, routes=rows[:most]))
    return whole


def text_of_xml(octets: bytes) -> str:
    """Return the text of an XML file, in the encoding of its byte order mark or declaration.

    Raises:
        ValueError: it is in another encoding, or in an unknown one.
    """
    for mark, encoding in _MARKS:
        if octets.startswith(mark):
            return octets.decode(encoding)
    # XML without mark and declaration is UTF-8 (XML 1.0).
    declared = _DECLARED.match(octets)
    try:
        return octets.decode(declared[1].decode() if declared else "utf-8")
    except LookupError as exc:
        raise ValueError(str(exc)) from None
