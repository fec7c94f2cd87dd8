"""The control protocol's words about buses; docs/control.md is their description.

Octets are hexadecimal digits, slaves are station addresses.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any, Literal

from msgspec import Meta

from devicebus.errors import BusError
from devicebus.mailbox.conversation import RESPONSE_TIMEOUT_NS, MailboxRequest
from devicebus.master.access import DatagramReply, DatagramRequest
from devicebus.wire.datagram import Command
from eap.appliance.control import ErrorCode, Parameters
from eap.codec.mailbox import MailboxType
from eap.errors import ControlError

BUS_METHODS = (
    "bus_describe",
    "bus_open",
    "bus_ask",
    "bus_close",
    "bus_transfer",
    "bus_bring",
    "bus_fault",
    "bus_forget",
)

MAX_CONVERSATIONS = 16
"""Open on one connection."""
IDLE_S = 10.0
"""A conversation in which nothing is asked for so long is ended: others may wait for it."""
TURN_S = 30.0
"""How long the turn at a mailbox is waited for."""
MARGIN_S = 10.0
"""Beyond the time-out of a mailbox message: those of other protocols may go first."""
PATIENCE_S = 5.0
"""How long a bus that is not up yet, or whose engine starts again, is waited for."""
TRANSFER_S = 5.0
"""What datagrams that are passed on may take."""
BRING_S = 60.0
"""What bringing slaves to a state may take."""

MS = 1_000_000
_MAX_MS = 60_000

Station = Annotated[int, Meta(ge=0, le=0xFFFF)]
Protocol = Literal["aoe", "eoe", "coe", "foe", "soe", "voe"]
State = Literal["INIT", "PREOP", "BOOT", "SAFEOP", "OP"]
Duration = Annotated[int, Meta(ge=0, le=_MAX_MS)]
DatagramRow = tuple[int, int, int, str, int]
"""Command, ADP, ADO, octets, tries (0: as the master's settings say)."""
ReplyRow = tuple[int, str, int]
"""Working counter, octets, tries."""


class BusParameters(Parameters, frozen=True, kw_only=True):
    """Base of those that name a bus."""

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
    """``bus_fault``: what a simulated segment is told."""

    command: dict[str, Any]


class BusForgetParameters(BusParameters, frozen=True, kw_only=True):
    """``bus_forget``: faults that are over are not shown any more."""


def protocol_of(kind: MailboxType) -> str:
    """Return the word for a mailbox type."""
    return kind.name.lower()


def kind_of(protocol: str) -> MailboxType:
    """Return the mailbox type for a word."""
    return MailboxType[protocol.upper()]


def ask_parameters(ask: MailboxRequest) -> dict[str, Any]:
    """Return a step of a conversation as parameters, without the conversation."""
    return {
        "request": ask.request.hex(),
        "listen": ask.listen,
        "timeout_ms": _to_ms(ask.timeout_ns),
        "delay_ms": _to_ms(ask.delay_ns),
        "expects_reply": ask.expects_reply,
    }


def to_ask(kind: MailboxType, wanted: BusAskParameters) -> MailboxRequest:
    """Return the step that parameters tell of."""
    return MailboxRequest(
        kind,
        to_octets(wanted.request),
        listen=wanted.listen,
        timeout_ns=wanted.timeout_ms * MS,
        delay_ns=wanted.delay_ms * MS,
        expects_reply=wanted.expects_reply,
    )


def datagram_row(access: DatagramRequest) -> DatagramRow:
    """Return a datagram as a row."""
    return access.command, access.adp, access.ado, access.data.hex(), access.tries


def to_access(row: DatagramRow) -> DatagramRequest:
    """Return the datagram of a row; raise ControlError if there is none like it."""
    command, adp, ado, octets, tries = row
    try:
        return DatagramRequest(Command(command), adp, ado, to_octets(octets), tries)
    except ValueError:
        reason = f"params: {command} is no command of a datagram"
        raise ControlError(reason, code=ErrorCode.BAD_REQUEST) from None


def reply_row(reply: DatagramReply) -> ReplyRow:
    """Return what came back as a row."""
    return reply.wkc, reply.data.hex(), reply.tries


def to_replies(rows: Sequence[ReplyRow]) -> list[DatagramReply]:
    """Return what came back, from rows; raise BusError if they are none."""
    try:
        return [DatagramReply(bytes.fromhex(octets), wkc, tries) for wkc, octets, tries in rows]
    except (TypeError, ValueError):
        raise BusError("what came back over the control socket is no reply") from None


def to_octets(text: str) -> bytes:
    """Read hexadecimal digits; raise ControlError if there is anything else."""
    try:
        return bytes.fromhex(text)
    except ValueError:
        reason = f"params: {text[:20]!r} is not pairs of hexadecimal digits"
        raise ControlError(reason, code=ErrorCode.BAD_REQUEST) from None


def _to_ms(ns: int) -> int:
    return -(-ns // MS)
