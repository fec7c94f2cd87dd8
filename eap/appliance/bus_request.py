"""What services ask the engine to do on a bus, and what it answers: one message each.

They travel as MessagePack over a SOCK_SEQPACKET pair.  Requests are small steps, such as one
mailbox message: whole transfers, files and retries are the business of who asks.
"""

from __future__ import annotations

from typing import TypeAlias

import msgspec

from eap.appliance.station_request import StationRequest


class Message(msgspec.Struct, frozen=True, kw_only=True, tag_field="do"):
    """Base of all requests; *bus* counts the bus ports of the appliance in the handover's order."""

    id: int
    """Chosen by who asks; the answer repeats it."""
    bus: int


class Describe(Message, frozen=True, tag="describe"):
    """Say how the bus is: answered by *report*."""


class AskMailbox(Message, frozen=True, kw_only=True, tag="mailbox"):
    """One step of a conversation with a slave's mailbox: answered by *data*.

    Fields as those of ``devicebus.mailbox.conversation.Ask``.
    """

    station: int
    type: int
    request: bytes
    listen: bool = False
    timeout_ns: int
    delay_ns: int = 0
    expects_reply: bool = True


class Datagram(msgspec.Struct, frozen=True, array_like=True):
    """One datagram, as ``devicebus.master.access.Access``."""

    command: int
    adp: int
    ado: int
    data: bytes
    tries: int


class Outcome(msgspec.Struct, frozen=True, array_like=True):
    """What came back for one datagram, as ``devicebus.master.access.Reply``."""

    wkc: int
    data: bytes
    tries: int


class Transfer(Message, frozen=True, kw_only=True, tag="transfer"):
    """One step of a procedure, datagrams without logical ones: answered by *outcomes*."""

    datagrams: tuple[Datagram, ...]


class Bring(Message, frozen=True, kw_only=True, tag="bring"):
    """Bring a slave to an AL state where it is kept then; 0 is all slaves.  Answered when there."""

    station: int
    target: int


class Forget(Message, frozen=True, tag="forget"):
    """Forget the faults that are over: answered when done."""


class Republish(Message, frozen=True, tag="republish"):
    """Send a BusChange with all slaves, answered behind it: the sender knows nothing of the bus."""


class Ping(msgspec.Struct, frozen=True, kw_only=True, tag_field="do", tag="ping"):
    """Answered without anything; changes that the engine has noticed come before the answer."""

    id: int


class Cancel(msgspec.Struct, frozen=True, kw_only=True, tag_field="do", tag="cancel"):
    """Whoever asked *id* does not wait any more: not answered."""

    id: int


BusRequest: TypeAlias = Describe | AskMailbox | Transfer | Bring | Forget | Republish
Request: TypeAlias = BusRequest | Ping | Cancel | StationRequest


class PortErrorReport(msgspec.Struct, frozen=True, array_like=True):
    """How many nanoseconds ago the error counters of a port grew first and last."""

    port: int
    since_ns: int
    until_ns: int


class Failure(msgspec.Struct, frozen=True):
    """Why a request was not done: the name of one of ``devicebus.errors``, and its text."""

    kind: str
    message: str
    detail: int = 0
    """Mailbox error code."""


class SlaveDescription(msgspec.Struct, frozen=True, kw_only=True):
    """A slave without times and counters that run: all of it changes by an event only."""

    station: int
    name: str
    vendor: int
    product: int
    revision: int
    serial: int
    alias: int
    state: int
    """AL state where it was brought, 0 if it does not answer."""
    target: int
    to_slave: int = 0
    to_master: int = 0
    """Octets of the mailboxes, 0 while none is open."""
    mailbox_fault: Failure | None = None
    """Why none is open: a NoMailboxError, or a MailboxClosedError that will pass."""
    protocols: int = 0
    """As in its EEPROM."""
    order: str = ""
    """Order code in its EEPROM."""
    usual_to_slave: int = 0
    usual_to_master: int = 0
    """Octets of the mailboxes in its EEPROM, whatever its state."""
    port_physics: int = 0
    """As in its EEPROM: four bits a port, 0 none, 1 MII, 3 E-bus."""
    link_preset: int = 0
    """Bits 0 to 2: ports 1 to 3 led to a slave when it was found; bits 4 to 6: they had a link."""
    losses: int = 0
    """How often it has stopped answering."""
    departures: int = 0
    """How often it has left its state by itself."""
    al_code: int = 0
    """AL status code when it last did."""
    fault: str = ""
    """Why it is not where it belongs."""


class SlaveReport(SlaveDescription, frozen=True, kw_only=True):
    """A slave with the times of its faults."""

    past_fault: str = ""
    """The same of the last time, if that is over."""
    since_ns: int | None = None
    """How many nanoseconds ago *fault* or *past_fault* began."""
    until_ns: int | None = None
    """How many nanoseconds ago *past_fault* was over."""
    port_errors: tuple[PortErrorReport, ...] = ()
    """Ports whose errors were counted while the master looked."""


class BusReport(msgspec.Struct, frozen=True, kw_only=True):
    """How a bus is; counters since the engine started, times in nanoseconds."""

    is_up: bool
    """Whether it has been brought up, wherever its slaves are now."""
    fault: str = ""
    """Why not."""
    slaves: tuple[SlaveReport, ...] = ()
    silent_since_ns: int | None = None
    """How many nanoseconds ago frames stopped coming back, the last time."""
    silent_until_ns: int | None = None
    """How many nanoseconds ago they came back again."""
    frames_sent: int = 0
    frames_received: int = 0
    frames_late: int = 0
    """Frames that came back after their time-out: the bus or this machine was slow."""
    frames_lost: int = 0
    """Frames that never came back."""
    frames_retried: int = 0
    timeout_ns: int = 0
    """How long the next frame may be under way before it is sent again."""
    round_trip_ns: int = 0
    """Mean of the latest round trips, 0 before the first."""
    cycles: int = 0
    cycles_good: int = 0
    wkc_errors: int = 0
    cycles_late: int = 0
    cycles_lost: int = 0
    cycles_skipped: int = 0
    """Cycles that were not sent, because the ones before had not come back."""
    expected_wkc: int = 0
    received_wkc: int = 0
    trip_ns: int = 0
    max_trip_ns: int = 0
    malformed: int = 0
    """Messages of services that were no request, for all buses of the engine together."""
    dropped: int = 0
    """Answers that services did not take, likewise."""


class Answer(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True, tag="answer"):
    """The answer to one request: *failure*, or what the request says."""

    id: int
    failure: Failure | None = None
    data: bytes = b""
    counter: int = 0
    """Of the mailbox header of a slave's reply."""
    outcomes: tuple[Outcome, ...] = ()
    report: BusReport | None = None


class Hello(msgspec.Struct, frozen=True, tag="hello"):
    """The first message of an engine: what was asked of the one before is not answered."""

    pid: int


class Heard(msgspec.Struct, frozen=True, tag="heard"):
    """What a slave sent unasked: an Ethernet frame, an emergency, a notification."""

    bus: int
    station: int
    kind: int
    """Mailbox type of the message."""
    data: bytes
    """What stands behind its mailbox header."""


class BusChange(msgspec.Struct, frozen=True, kw_only=True, tag="change"):
    """Slaves of a bus that have changed, and all that is known of the bus beside its slaves.

    It comes before the answer to any request that was done after the change.
    """

    bus: int
    is_up: bool
    fault: str
    stations: tuple[int, ...]
    """All slaves in the order of the bus."""
    slaves: tuple[SlaveDescription, ...]


FromEngine: TypeAlias = Answer | Hello | Heard | BusChange
