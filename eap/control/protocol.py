"""Control protocol, version 1: JSON lines, and the records of its general methods.

Nothing here opens a socket.  Server and client share these records, so that they cannot disagree
about a name; docs/control.md describes them.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Iterator, Mapping
from contextlib import contextmanager
from enum import StrEnum, auto
from typing import Any, Generic, Literal, TypeAlias, TypeVar

import msgspec

from eap.ams.spec import Role
from eap.codec.datatypes import Plain
from eap.errors import ControlError, EnvironmentalError
from eap.ids import decode_value, encode_value
from eap.pd.report import PdRow
from eap.suggest import suggest

VERSION = 1
MAX_LINE = 1 << 23
"""Octets of the longest line in either direction, its newline included."""
MAX_CLIENTS = 64
MAX_SUBSCRIPTIONS = 16
"""Per connection."""
SLOW_READER_S = 10.0
"""A client that takes nothing for this long while a line waits for it is disconnected."""


class ErrorCode(StrEnum):
    """Reason of an error, for programs; the message is for people."""

    BAD_REQUEST = auto()
    """Not JSON, not this protocol, or parameters of the wrong form."""
    VERSION = auto()
    UNKNOWN_METHOD = auto()
    UNKNOWN_NAME = auto()
    """No such station, port, variable or conversation here."""
    VALUE = auto()
    """Not a value of the variable's type, or not a command of a simulated bus."""
    REFUSED = auto()
    """Not a variable that clients write, or access rules or this bus do not allow it."""
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
    """Error of a request that was not done."""

    code: str
    message: str
    kind: str = ""
    """With code ``bus``: the name of one of ``devicebus.errors``."""
    detail: int = 0
    """Its number, as ``bus_errors`` packs it; with code ``abort`` the abort code."""


class ControlReply(msgspec.Struct, frozen=True, omit_defaults=True):
    """One line from the server: a result, an error, or one event of a subscription."""

    v: int
    id: int | None = None
    result: Any = None
    error: Failure | None = None
    subscription: int | None = None
    event: dict[str, Any] | None = None


# Unknown fields are refused: a misspelt one would make another request of it.
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


class WriteOrigin(Parameters, frozen=True):
    """Author of a write that a program makes for a user, for access rules and audit.

    Attributes:
        user: Name of the user, empty for one without login.
        host: Address of the user's program; of MQTT the topic.
        comment: The user's reason.
        transport: Transport of the program, as access rules name it.
        role: Role of the user, which access rules name, too; None for one without login.
    """

    user: str
    host: str
    comment: str = ""
    transport: Literal["web", "mqtt", "opcua", "s7", "modbus"] = "web"
    role: Role | None = None


class WriteParameters(Parameters, frozen=True):
    """``write``: all values are checked before the first is written."""

    station: str
    values: dict[str, Plain]
    origin: WriteOrigin | None = None


class SubscribeParameters(Parameters, frozen=True):
    """``subscribe``: every *period_ms*, or only *on* change, looking every *period_ms*."""

    station: str
    names: tuple[str, ...] = ()
    period_ms: int = 500
    on: Literal["period", "change"] = "period"


class UnsubscribeParameters(Parameters, frozen=True):
    """``unsubscribe``: *subscription* as the answer to ``subscribe`` named it."""

    subscription: int


class Document(msgspec.Struct, frozen=True):
    """Base of answers; a field that a newer appliance adds is ignored."""


class Subscribed(Document, frozen=True):
    """Answer to ``subscribe``."""

    subscription: int


class Unsubscribed(Document, frozen=True):
    """Answer to ``unsubscribe``."""

    unsubscribed: int


class Hello(Document, frozen=True, kw_only=True):
    """Answer to ``hello``; a field with a default is missing in answers of older releases.

    Attributes:
        version: Of the protocol.
        release: Of the appliance.
        plant: Name of its plant.
        pid: Of its services.
        stations: Those that run.
        host: Host of the plant that it runs on; empty for a plant without ``hosts``.
        plant_file: With which it was started; empty for a blank station.
        audit_required: Whether changes that the audit cannot record are refused.
        by_ads: Methods for clients by ADS.
    """

    version: int
    release: str = ""
    plant: str
    pid: int = 0
    stations: list[str]
    host: str = ""
    plant_file: str = ""
    audit_required: bool = False
    by_ads: list[str] = []


class VariableRow(Document, frozen=True):
    """One variable of an answer to ``variables``."""

    name: str
    type: str
    writer: str
    unit: str
    comment: str


class Values(Document, frozen=True):
    """Answer to ``read``: values of one moment.

    *quality* is that of received variables and of those read from controllers, in units of 100 us;
    None before the first time.  *stale* has those of them that do not arrive any more.  *time_ns*
    is the Unix time of the cycle; 0 from an appliance of an older release.
    """

    station: str
    cycle: int
    values: dict[str, Any]
    quality: dict[str, int | None]
    time_ns: int = 0
    stale: tuple[str, ...] = ()


class ValuesEvent(Values, frozen=True):
    """Event of a subscription; *skipped* cycles since the one before were not sampled."""

    skipped: int = 0


class Written(Document, frozen=True):
    """Answer to ``write``: the number of values."""

    written: int


class Stopping(Document, frozen=True):
    """Answer to ``stop``."""

    stopping: bool


ParametersT = TypeVar("ParametersT", bound=Parameters)
AnswerT = TypeVar("AnswerT")
ItemT = TypeVar("ItemT")
ServedMethod: TypeAlias = tuple[str, Callable[[dict[str, Any]], Any]]
"""Name, and function of the undecoded parameters."""

_REQUEST = msgspec.json.Decoder(Request)
_REPLY = msgspec.json.Decoder(ControlReply)


class Method(Generic[ParametersT, AnswerT]):
    """Method of the protocol: its name, the record of its parameters, the type of its answer."""

    def __init__(self, name: str, takes: type[ParametersT], returns: type[AnswerT]) -> None:
        self.name = name
        self.takes = takes
        self.returns = returns

    def served_by(
        self, function: Callable[[ParametersT], AnswerT | Awaitable[AnswerT]]
    ) -> ServedMethod:
        """Return the server's entry of this method, which decodes the parameters."""
        return self.name, lambda params: function(parameters(params, self.takes))

    def decode(self, result: Any) -> AnswerT:
        """Return a result as a record; raise ControlError if it is none."""
        try:
            return msgspec.convert(result, self.returns, dec_hook=decode_value)
        except msgspec.ValidationError as exc:
            reason = f"the answer to {self.name}: {exc}"
            raise ControlError(reason, code=ErrorCode.BAD_REQUEST) from None


HELLO = Method("hello", NoParameters, Hello)
PD_LIST = Method("pd_list", PdListParameters, list[PdRow])
VARIABLES = Method("variables", VariablesParameters, list[VariableRow])
READ = Method("read", ReadParameters, Values)
WRITE = Method("write", WriteParameters, Written)
SUBSCRIBE = Method("subscribe", SubscribeParameters, Subscribed)
UNSUBSCRIBE = Method("unsubscribe", UnsubscribeParameters, Unsubscribed)
STOP = Method("stop", NoParameters, Stopping)


def decode_request(line: bytes) -> Request:
    """Read one line of a client; raise ControlError with the reason if it is not a request."""
    try:
        request = _REQUEST.decode(line)
    except ValueError as exc:  # of msgspec, or of UTF-8
        raise ControlError(f"not a request: {exc}", code=ErrorCode.BAD_REQUEST) from None
    except RecursionError:
        # msgspec raises RecursionError, which is none of its own errors.
        raise ControlError("not a request: nested too deep", code=ErrorCode.BAD_REQUEST) from None
    # Before the parameters are looked at: another version may give them another meaning.
    if request.v != VERSION:
        raise ControlError(
            f"protocol version {request.v}, this appliance speaks {VERSION}",
            code=ErrorCode.VERSION,
        )
    return request


def parameters(params: dict[str, Any], kind: type[ParametersT]) -> ParametersT:
    """Check *params*; raise ControlError that names the first wrong one."""
    try:
        return msgspec.convert(params, kind, dec_hook=decode_value)
    except msgspec.ValidationError as exc:
        raise ControlError(f"params: {exc}", code=ErrorCode.BAD_REQUEST) from None


def of_station(name: str, known: Mapping[str, ItemT]) -> ItemT:
    """Return the item of *known* for a station; raise ControlError that suggests similar names."""
    try:
        # The name is of a user: a suggestion costs less than a look into the plant file.
        return known[name]
    except KeyError:
        reason = f"unknown station {name!r}{suggest(name, known)}"
        raise ControlError(reason, code=ErrorCode.UNKNOWN_NAME) from None


@contextmanager
def unless_unavailable() -> Iterator[None]:
    """Convert EnvironmentalError to ControlError: this machine cannot store or reach something."""
    try:
        yield
    except EnvironmentalError as exc:
        raise ControlError(str(exc), code=ErrorCode.UNAVAILABLE) from None


def request_id(line: bytes) -> int | None:
    """Return the id of a line that is otherwise refused, so that its sender can match the error."""
    try:
        # The line may have any form: its number is looked for without the record.
        number = msgspec.json.decode(line)["id"]
    except (ValueError, RecursionError, KeyError, TypeError):
        return None
    # An id of another type could not be the one of a request.
    return number if isinstance(number, int) else None


def decode_reply(line: bytes) -> ControlReply:
    """Read one line of a server; raise ControlError if it is none."""
    try:
        return _REPLY.decode(line)
    except (ValueError, RecursionError) as exc:
        raise ControlError(f"not an answer: {exc}", code=ErrorCode.BAD_REQUEST) from None


def encode_request(number: int, method: str, params: dict[str, Any]) -> bytes:
    """Return the line of a request."""
    return _line({"v": VERSION, "id": number, "method": method, "params": params})


def encode_result(number: int | None, result: Any) -> bytes:
    """Return the line of an answer, or of an error if the answer would be too long."""
    line = _line({"v": VERSION, "id": number, "result": result})
    # The client's reader has the same limit, and would lose the connection over a longer line.
    if len(line) <= MAX_LINE:
        return line
    reason = f"the answer has {len(line)} bytes, at most {MAX_LINE}: ask for fewer names"
    return encode_error(number, ControlError(reason, code=ErrorCode.BUSY))


def encode_error(number: int | None, error: ControlError) -> bytes:
    """Return the line of a refusal."""
    return encode_failure(number, Failure(error.code, str(error)))


def encode_failure(number: int | None, failure: Failure) -> bytes:
    """Return the line of a refusal that says more than an error does."""
    return _line({"v": VERSION, "id": number, "error": failure})


def encode_event(subscription: int, event: ValuesEvent | dict[str, Any]) -> bytes:
    """Return the line of one event."""
    return _line({"v": VERSION, "subscription": subscription, "event": event})


def _line(message: dict[str, Any]) -> bytes:
    return msgspec.json.encode(message, enc_hook=encode_value) + b"\n"
