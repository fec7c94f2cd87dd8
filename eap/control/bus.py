"""Methods of the control protocol for buses and gateways; docs/control.md is their description.

The records of requests and replies are those of ``devicebus``; JSON has their bytes as hexadecimal
digits and times in milliseconds.  Slaves are station addresses.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta

from devicebus.errors import BusError
from devicebus.mailbox.conversation import RESPONSE_TIMEOUT_NS, MailboxRequest
from devicebus.wire.datagram import Command, DatagramReply, DatagramRequest
from eap.codec.mailbox import MailboxType
from eap.control.protocol import Document, ErrorCode, Method, Parameters
from eap.errors import ControlError
from eap.runtime.engine_messages import BusReport

MAX_CONVERSATIONS = 16
"""Open on one connection."""
IDLE_S = 10.0
"""A conversation without a request for so long is ended: others may wait for it."""
TURN_S = 30.0
"""Limit for the wait for a turn at a mailbox."""
ENGINE_MARGIN_S = 10.0
"""Beyond the time-out of a mailbox message: those of other protocols may go first."""
BUS_WAIT_UP_S = 5.0
"""Limit for the wait for a bus that is not up yet, or whose engine starts again."""
TRANSFER_S = 5.0
"""Limit for datagrams."""
BRING_S = 60.0
"""Limit for bringing slaves to a state."""

MS = 1_000_000
_MAX_MS = 60_000

Station = Annotated[int, Meta(ge=0, le=0xFFFF)]
Protocol = Literal["aoe", "eoe", "coe", "foe", "soe", "voe"]
"""Names of :class:`MailboxType` in lower case; :func:`kind_of` relies on that."""
State = Literal["INIT", "PREOP", "BOOT", "SAFEOP", "OP"]
Duration = Annotated[int, Meta(ge=0, le=_MAX_MS)]
# Rows, not objects: a transfer may have hundreds of datagrams.
DatagramRow = tuple[int, int, int, str, int]
"""Command, ADP, ADO, bytes, tries (0: as the master's settings say)."""
ReplyRow = tuple[int, str, int]
"""Working counter, bytes, tries."""


class BusParameters(Parameters, frozen=True, kw_only=True):
    """Base of parameters that name a bus."""

    station: str
    port: str


class BusDescribeParameters(BusParameters, frozen=True, kw_only=True):
    """``bus_describe``: at once, or when the bus is up."""

    wait: bool = False


class BusOpenParameters(BusParameters, frozen=True, kw_only=True):
    """``bus_open``: begins a conversation."""

    slave: Station
    protocol: Protocol


class BusAskParameters(Parameters, frozen=True, kw_only=True):
    """``bus_ask``: one step of a conversation."""

    conversation: int
    request: str
    listen: bool = False
    timeout_ms: Duration = RESPONSE_TIMEOUT_NS // MS
    delay_ms: Duration = 0
    expects_reply: bool = True


class BusCloseParameters(Parameters, frozen=True):
    """``bus_close``: the conversation is over."""

    conversation: int


class BusTransferParameters(BusParameters, frozen=True, kw_only=True):
    """``bus_transfer``: datagrams that go out together."""

    datagrams: Annotated[list[DatagramRow], Meta(min_length=1, max_length=256)]


class BusBringParameters(BusParameters, frozen=True, kw_only=True):
    """``bus_bring``: one slave, or with 0 all."""

    slave: Station = 0
    state: State


class BusFaultParameters(BusParameters, frozen=True, kw_only=True):
    """``bus_fault``: a command for a simulated segment."""

    command: dict[str, Any]


class BusForgetParameters(BusParameters, frozen=True, kw_only=True):
    """``bus_forget``: faults that are over are not shown any more."""


class OpenConversation(msgspec.Struct, frozen=True):
    """Number of a conversation that was opened."""

    conversation: int


class MailboxData(msgspec.Struct, frozen=True):
    """Reply of a slave without its mailbox header, as hexadecimal digits."""

    data: str


class ClosedConversation(msgspec.Struct, frozen=True):
    """Number of a conversation that is closed."""

    closed: int


class DatagramReplies(msgspec.Struct, frozen=True):
    """Replies to datagrams, in their order."""

    replies: list[ReplyRow]


class ReachedState(msgspec.Struct, frozen=True):
    """State in which the slaves are now."""

    state: State


class Done(msgspec.Struct, frozen=True):
    """Answer without content."""

    ok: bool = True


BUS_DESCRIBE = Method("bus_describe", BusDescribeParameters, BusReport)
BUS_OPEN = Method("bus_open", BusOpenParameters, OpenConversation)
BUS_ASK = Method("bus_ask", BusAskParameters, MailboxData)
BUS_CLOSE = Method("bus_close", BusCloseParameters, ClosedConversation)
BUS_TRANSFER = Method("bus_transfer", BusTransferParameters, DatagramReplies)
BUS_BRING = Method("bus_bring", BusBringParameters, ReachedState)
BUS_FAULT = Method("bus_fault", BusFaultParameters, Done)
BUS_FORGET = Method("bus_forget", BusForgetParameters, Done)
BUS_METHODS = tuple(
    method.name
    for method in (
        BUS_DESCRIBE,
        BUS_OPEN,
        BUS_ASK,
        BUS_CLOSE,
        BUS_TRANSFER,
        BUS_BRING,
        BUS_FAULT,
        BUS_FORGET,
    )
)


def protocol_of(kind: MailboxType) -> str:
    """Return the word for a mailbox type."""
    return kind.name.lower()


def kind_of(protocol: str) -> MailboxType:
    """Return the mailbox type for a word."""
    return MailboxType[protocol.upper()]


def request_parameters(request: MailboxRequest) -> dict[str, Any]:
    """Return a step of a conversation as parameters, without the conversation."""
    return {
        "request": request.request.hex(),
        "listen": request.listen,
        "timeout_ms": _to_ms(request.timeout_ns),
        "delay_ms": _to_ms(request.delay_ns),
        "expects_reply": request.expects_reply,
    }


def to_request(kind: MailboxType, wanted: BusAskParameters) -> MailboxRequest:
    """Return the step of a conversation that parameters describe."""
    return MailboxRequest(
        kind,
        to_octets(wanted.request),
        listen=wanted.listen,
        # Milliseconds in JSON: its numbers are doubles in many languages, which nanoseconds exceed.
        timeout_ns=wanted.timeout_ms * MS,
        delay_ns=wanted.delay_ms * MS,
        expects_reply=wanted.expects_reply,
    )


def datagram_row(request: DatagramRequest) -> DatagramRow:
    """Return a datagram as a row."""
    return request.command, request.adp, request.ado, request.data.hex(), request.tries


def to_datagram(row: DatagramRow) -> DatagramRequest:
    """Return the datagram of a row; raise ControlError if it has no such command."""
    command, adp, ado, octets, tries = row
    try:
        # The command is a plain number in the row: that of the wire, for clients in any language.
        return DatagramRequest(Command(command), adp, ado, to_octets(octets), tries)
    except ValueError:
        reason = f"params: {command} is no command of a datagram"
        raise ControlError(reason, code=ErrorCode.BAD_REQUEST) from None


def reply_row(reply: DatagramReply) -> ReplyRow:
    """Return a reply as a row."""
    return reply.wkc, reply.data.hex(), reply.tries


def to_replies(rows: Sequence[ReplyRow]) -> list[DatagramReply]:
    """Return the replies of rows; raise BusError if they have other digits than hexadecimal."""
    try:
        return [DatagramReply(bytes.fromhex(octets), wkc, tries) for wkc, octets, tries in rows]
    except ValueError:
        # Replies come from the appliance: a client has nothing to correct.
        raise BusError("malformed reply on the control socket") from None


def to_octets(text: str) -> bytes:
    """Read hexadecimal digits; raise ControlError if there is anything else."""
    try:
        return bytes.fromhex(text)
    except ValueError:
        reason = f"params: {text[:20]!r} is not pairs of hexadecimal digits"
        raise ControlError(reason, code=ErrorCode.BAD_REQUEST) from None


def _to_ms(ns: int) -> int:
    # Rounded up: a short time-out must not become 0.
    return -(-ns // MS)


class GatewayParameters(Parameters, frozen=True, kw_only=True):
    """``gateway_start``, ``gateway_stop`` and ``gateway_status``."""

    station: str
    port: str = ""
    """A bus port; empty for all of the station."""


class GatewaySettings(Document, frozen=True):
    """Settings of the plant file."""

    answer_ms: int
    silent: bool
    in_flight: int
    rate: int
    clients: int


class TransferRow(Document, frozen=True):
    """Transfer under way: address of the slave, and protocol."""

    address: int
    protocol: str


class GatewayClientRow(Document, frozen=True, kw_only=True):
    """Client of a gateway."""

    transport: str
    address: str
    requests: int
    repeated: int
    errors: int
    waiting: int
    transfers: list[TransferRow]


class MailboxFigures(Document, frozen=True, kw_only=True):
    """Requests to one mailbox in one protocol; address 0 is the master."""

    address: int
    protocol: str
    requests: int
    replies: int
    errors: dict[str, int]
    last_error: str
    mean_us: float | None
    slowest_us: float
    name: str = ""
    """Of a remote slave in the plant."""


class GatewayRow(Document, frozen=True, kw_only=True):
    """One gateway of an answer to all three methods."""

    station: str
    port: str
    served: list[str]
    state: Literal["running", "stopped"]
    dropped: int
    settings: GatewaySettings
    clients: list[GatewayClientRow]
    slaves: list[MailboxFigures]


GATEWAY_START = Method("gateway_start", GatewayParameters, list[GatewayRow])
GATEWAY_STOP = Method("gateway_stop", GatewayParameters, list[GatewayRow])
GATEWAY_STATUS = Method("gateway_status", GatewayParameters, list[GatewayRow])
