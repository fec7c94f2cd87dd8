"""The control protocol on paper: JSON lines, version 1.  docs/control.md is its description.

Nothing here opens a socket: the server, the command line's client and the tests share these
records, so that they cannot disagree about a name.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from enum import StrEnum, auto
from typing import Any, Literal, TypeVar

import msgspec

from eap.errors import ControlError, EnvironmentalError
from eap.near import near

VERSION = 1
MAX_LINE = 1 << 23
"""Octets of the longest line in either direction, its newline included."""
MAX_CLIENTS = 64
MAX_SUBSCRIPTIONS = 16
"""Per connection."""
SLOW_READER_S = 10.0
"""A client that takes nothing for this long while a line waits for it is disconnected."""


class ErrorCode(StrEnum):
    """What a program does about a refusal; the message beside it is for people."""

    BAD_REQUEST = auto()
    """Not JSON, not this protocol, or parameters of the wrong form."""
    VERSION = auto()
    UNKNOWN_METHOD = auto()
    UNKNOWN_NAME = auto()
    """No such station, port, variable or conversation here."""
    VALUE = auto()
    """Not a value of the variable's type, or not a command of a simulated bus."""
    REFUSED = auto()
    """Somebody else writes this variable, or this bus does not allow it."""
    BUSY = auto()
    """A limit is reached: clients, subscriptions, conversations, or the length of an answer."""
    UNAVAILABLE = auto()
    """The process image cannot be read now, or there is no engine."""
    BUS = auto()
    """A bus or a slave did not do it; the kind says in which way."""
    ABORT = auto()
    """A dictionary refuses an SDO; the detail is its abort code."""
    INTERNAL = auto()


class Request(msgspec.Struct, frozen=True):
    """One line from a client."""

    v: int
    method: str
    id: int | None = None
    params: dict[str, Any] = {}


class Failure(msgspec.Struct, frozen=True, omit_defaults=True):
    """Why a request was not done."""

    code: str
    message: str
    kind: str = ""
    """With code ``bus``: the name of one of ``devicebus.errors``."""
    detail: int = 0
    """Its number, as ``bus_errors`` packs it; with code ``abort`` the abort code."""


class Reply(msgspec.Struct, frozen=True, omit_defaults=True):
    """One line from the server: a result, an error, or one event of a subscription."""

    v: int
    id: int | None = None
    result: Any = None
    error: Failure | None = None
    subscription: int | None = None
    event: dict[str, Any] | None = None


class Parameters(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Base of the parameters of all methods."""


class NoParameters(Parameters, frozen=True):
    """``hello``, ``status`` and ``stop`` take none."""


class PdListParameters(Parameters, frozen=True):
    """``pd_list``: of one station, or of all."""

    station: str = ""


class VariablesParameters(Parameters, frozen=True):
    """``variables``: the directory of one station."""

    station: str


class ReadParameters(Parameters, frozen=True):
    """``read``: no names means all variables."""

    station: str
    names: tuple[str, ...] = ()


class WriteParameters(Parameters, frozen=True):
    """``write``: all values are checked before the first is written."""

    station: str
    values: dict[str, bool | int | float | str | list[bool | int | float]]


class SubscribeParameters(Parameters, frozen=True):
    """``subscribe``: every *period_ms*, or only *on* change, looking every *period_ms*."""

    station: str
    names: tuple[str, ...] = ()
    period_ms: int = 500
    on: Literal["period", "change"] = "period"


class UnsubscribeParameters(Parameters, frozen=True):
    """``unsubscribe``: *subscription* as the answer to ``subscribe`` named it."""

    subscription: int


ParametersT = TypeVar("ParametersT", bound=Parameters)
ItemT = TypeVar("ItemT")

_REQUEST = msgspec.json.Decoder(Request)
_REPLY = msgspec.json.Decoder(Reply)


def decode_request(line: bytes) -> Request:
    """Read one line of a client; raise ControlError with the reason if it is not a request."""
    try:
        request = _REQUEST.decode(line)
    except msgspec.DecodeError as exc:
        raise ControlError(f"not a request: {exc}", code=ErrorCode.BAD_REQUEST) from None
    if request.v != VERSION:
        raise ControlError(
            f"protocol version {request.v}, this appliance speaks {VERSION}",
            code=ErrorCode.VERSION,
        )
    return request


def parameters(params: dict[str, Any], kind: type[ParametersT]) -> ParametersT:
    """Check *params*; raise ControlError that names the first wrong one."""
    try:
        return msgspec.convert(params, kind)
    except msgspec.ValidationError as exc:
        raise ControlError(f"params: {exc}", code=ErrorCode.BAD_REQUEST) from None


def of_station(name: str, known: Mapping[str, ItemT]) -> ItemT:
    """Return what *known* has for a station; raise ControlError that says which comes near."""
    try:
        return known[name]
    except KeyError:
        reason = f"no station {name!r} here{near(name, known)}"
        raise ControlError(reason, code=ErrorCode.UNKNOWN_NAME) from None


@contextmanager
def unless_unavailable() -> Iterator[None]:
    """Refuse what this machine cannot do: keep something over a restart, ask another host."""
    try:
        yield
    except EnvironmentalError as exc:
        raise ControlError(str(exc), code=ErrorCode.UNAVAILABLE) from None


def request_id(line: bytes) -> int | None:
    """Return the id of a line that is otherwise refused, so that its sender can match the error."""
    try:
        number = msgspec.json.decode(line)["id"]
    except (msgspec.DecodeError, KeyError, TypeError):
        return None
    return number if isinstance(number, int) else None


def decode_reply(line: bytes) -> Reply:
    """Read one line of a server; raise ControlError if it is none."""
    try:
        return _REPLY.decode(line)
    except msgspec.DecodeError as exc:
        raise ControlError(f"not an answer: {exc}", code=ErrorCode.BAD_REQUEST) from None


def encode_request(number: int, method: str, params: dict[str, Any]) -> bytes:
    """Return the line of a request."""
    return _line({"v": VERSION, "id": number, "method": method, "params": params})


def encode_result(number: int | None, result: Any) -> bytes:
    """Return the line of an answer, or of an error if the answer would be too long."""
    line = _line({"v": VERSION, "id": number, "result": result})
    if len(line) <= MAX_LINE:
        return line
    reason = f"the answer has {len(line)} octets, at most {MAX_LINE}: ask for fewer names"
    return encode_error(number, ControlError(reason, code=ErrorCode.BUSY))


def encode_error(number: int | None, error: ControlError) -> bytes:
    """Return the line of a refusal."""
    return encode_failure(number, Failure(error.code, str(error)))


def encode_failure(number: int | None, failure: Failure) -> bytes:
    """Return the line of a refusal that says more than an error does."""
    return _line({"v": VERSION, "id": number, "error": failure})


def encode_event(subscription: int, event: dict[str, Any]) -> bytes:
    """Return the line of one event."""
    return _line({"v": VERSION, "subscription": subscription, "event": event})


def _line(message: dict[str, Any]) -> bytes:
    return msgspec.json.encode(message) + b"\n"
