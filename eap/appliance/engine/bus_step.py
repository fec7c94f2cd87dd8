"""One step of what services does on a bus, as the master runs it: a message, or some datagrams."""

from __future__ import annotations

from collections.abc import Sequence

import msgspec

from devicebus.errors import BusError
from devicebus.mailbox.conversation import Conversation, MailboxMessage, MailboxRequest
from devicebus.master.access import AS_SET, DatagramReply, DatagramRequest
from devicebus.master.link import MAX_DATA
from devicebus.master.procedure import Procedure
from devicebus.wire.datagram import Command
from eap.appliance.bus_request import AskMailbox, Datagram, Transfer
from eap.codec.mailbox import MailboxType

MAX_DATAGRAMS = 256
"""Of one transfer."""
MAX_TRIES = 8
_ALLOWED = frozenset(
    (
        *(Command.NOP, Command.APRD, Command.APWR, Command.APRW, Command.FPRD),
        *(Command.FPWR, Command.FPRW, Command.BRD),
    )
)
"""What does not disturb the slaves that others talk to: no logical ones, none that write to all."""


def to_ask(request: AskMailbox) -> MailboxRequest:
    """Return what is asked of a mailbox; raise BusError if there is no such protocol."""
    try:
        kind = MailboxType(request.type)
    except ValueError:
        raise BusError(f"there is no mailbox protocol {request.type}") from None
    return MailboxRequest(
        kind,
        request.request,
        listen=request.listen,
        timeout_ns=request.timeout_ns,
        delay_ns=request.delay_ns,
        expects_reply=request.expects_reply,
    )


def one_ask(ask: MailboxRequest) -> Conversation[MailboxMessage]:
    """Ask once and return the reply."""
    return (yield ask)


def to_accesses(request: Transfer) -> list[DatagramRequest]:
    """Return the datagrams to send.

    Raises:
        BusError: they are too many, one of them cannot be, or would disturb the slaves.
    """
    if not 1 <= len(request.datagrams) <= MAX_DATAGRAMS:
        raise BusError(f"{len(request.datagrams)} datagrams, expected 1 to {MAX_DATAGRAMS}")
    return [_to_access(each) for each in request.datagrams]


def one_step(accesses: Sequence[DatagramRequest]) -> Procedure[list[DatagramReply]]:
    """Send datagrams together and return what came back."""
    replies, _ = yield accesses
    return list(replies)


def _to_access(wanted: Datagram) -> DatagramRequest:
    command, adp, ado, data, tries = msgspec.structs.astuple(wanted)
    if command not in _ALLOWED:
        names = ", ".join(sorted(each.name for each in _ALLOWED))
        raise BusError(
            f"datagram with command {command}: it would disturb the slaves while they exchange"
            f" process data; expected one of {names}"
        )
    if not (0 <= adp <= 0xFFFF and 0 <= ado <= 0xFFFF and 1 <= len(data) <= MAX_DATA):
        raise BusError(
            f"datagram to 0x{adp:X}:0x{ado:X} with {len(data)} octets, expected addresses of 16"
            f" bits and 1 to {MAX_DATA} octets"
        )
    return DatagramRequest(Command(command), adp, ado, data, min(max(tries, AS_SET), MAX_TRIES))
