"""Messages between services and the engine: requests, replies, changes of a bus, errors as records.

They travel as MessagePack over a SOCK_SEQPACKET pair, one message each.  A request is a small step,
such as one mailbox message: services drives whole transfers, files and retries.
"""

from __future__ import annotations

from typing import TypeAlias

import msgspec

from devicebus.errors import NoMailboxError
from devicebus.mailbox.conversation import MailboxMessage, MailboxRequest
from devicebus.master.mailboxes import Unsolicited
from devicebus.wire.alstatus import AlState
from devicebus.wire.datagram import DatagramReply, DatagramRequest
from eap.errors import EapError
from eap.runtime.bus_errors import ErrorRecord, to_error


class StationMessage(msgspec.Struct, frozen=True, kw_only=True, tag_field="do"):
    """Base of both; answered without anything, or with a failure."""

    id: int
    """Chosen by the requester and repeated in the reply."""
    station: str


class Configure(StationMessage, frozen=True, tag="configure"):
    """Run another specification: answered when its first cycle is the next one."""

    path: str
    """A file with the StationSpec in lines (``record_to_lines``), there until the answer."""


class SetState(StationMessage, frozen=True, tag="set_state"):
    """Go to a device state, by all states between."""

    state: int
    """2 PreOp, 4 SafeOp, 8 Op."""


StationRequest: TypeAlias = Configure | SetState


class BusRequest(msgspec.Struct, frozen=True, kw_only=True, tag_field="do"):
    """Base of requests to a bus; *bus* is its number, as in BusSocket."""

    id: int
    """Chosen by the requester and repeated in the reply."""
    bus: int


class DescribeBus(BusRequest, frozen=True, tag="describe"):
    """Describe the bus: answered by *report*."""


class ExchangeMailbox(BusRequest, frozen=True, kw_only=True, tag="mailbox"):
    """Do one step of a conversation with a slave's mailbox: answered by *message*."""

    station: int
    request: MailboxRequest


class ExchangeDatagrams(BusRequest, frozen=True, kw_only=True, tag="transfer"):
    """Do one step of a procedure, without logical datagrams: answered by *replies*."""

    datagrams: tuple[DatagramRequest, ...]


class BringSlaves(BusRequest, frozen=True, kw_only=True, tag="bring"):
    """Bring a slave, or with 0 all, to an AL state where it is kept: answered when there."""

    station: int
    target: AlState


class ForgetFaults(BusRequest, frozen=True, tag="forget"):
    """Forget the faults that are over: answered when done."""


class Republish(BusRequest, frozen=True, tag="republish"):
    """Send a BusChange with all slaves, answered behind it: the sender knows nothing of the bus."""


class Ping(msgspec.Struct, frozen=True, kw_only=True, tag_field="do", tag="ping"):
    """Answered without anything; changes that the engine has noticed come before the answer."""

    id: int


class Cancel(msgspec.Struct, frozen=True, kw_only=True, tag_field="do", tag="cancel"):
    """Cancel request *id*, whose requester is gone: not answered."""

    id: int


EngineRequest: TypeAlias = (
    DescribeBus
    | ExchangeMailbox
    | ExchangeDatagrams
    | BringSlaves
    | ForgetFaults
    | Republish
    | Ping
    | Cancel
    | StationRequest
)


class PortErrorReport(msgspec.Struct, frozen=True, array_like=True):
    """Nanoseconds since the error counters of a port grew first and last."""

    port: int
    since_ns: int
    until_ns: int


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
    """Bytes of the mailboxes, 0 while none is open."""
    mailbox_fault: ErrorRecord | None = None
    """Reason that none is open: a NoMailboxError, or a MailboxClosedError that will pass."""
    protocols: int = 0
    """As in its EEPROM."""
    order: str = ""
    """Order code in its EEPROM."""
    usual_to_slave: int = 0
    usual_to_master: int = 0
    """Bytes of the mailboxes in its EEPROM, in any state."""
    port_physics: int = 0
    """As in its EEPROM: four bits a port, 0 none, 1 MII, 3 E-bus."""
    link_preset: int = 0
    """Bits 0 to 2: ports 1 to 3 led to a slave when it was found; bits 4 to 6: they had a link."""
    losses: int = 0
    """Times that it has stopped answering."""
    departures: int = 0
    """Times that it has left its state by itself."""
    al_code: int = 0
    """AL status code when it last did."""
    fault: str = ""
    """Reason why it is not in its target state."""
    is_optional: bool = False
    is_absent: bool = False
    """True while it is optional and not plugged in, which is no fault."""


def no_mailbox(slave: SlaveDescription) -> EapError:
    """Return the error for which no mailbox of a slave is open, as its master gives it."""
    if slave.mailbox_fault is not None:
        return to_error(slave.mailbox_fault)
    return NoMailboxError(f"slave {slave.station} ({slave.name}) has no open mailbox")


class EmergencyReport(msgspec.Struct, frozen=True, kw_only=True):
    """Emergency of a slave."""

    ago_ns: int
    protocol: str
    """``CoE`` or ``SoE``."""
    drive: int
    """Number of the drive, by SoE only."""
    code: int
    """0 takes the errors of its sender back."""
    register: int
    data: str
    """Five bytes of the vendor in hexadecimal digits."""


class SlaveReport(SlaveDescription, frozen=True, kw_only=True):
    """A slave with the times of its faults."""

    past_fault: str = ""
    """The same of the last time, if that is over."""
    since_ns: int | None = None
    """Nanoseconds since *fault* or *past_fault* began."""
    until_ns: int | None = None
    """Nanoseconds since *past_fault* was over."""
    mailbox_timeouts: int = 0
    """Requests without a reply since its mailbox was opened, or since ForgetFaults."""
    mailbox_timeout_ns: int | None = None
    """Nanoseconds since the last of them."""
    mailbox_late: int = 0
    """Replies that came after their request had timed out."""
    forwarded: int = 0
    """Mailbox messages that it sent to other slaves."""
    forward_dropped: int = 0
    """Mailbox messages from or to it that could not be forwarded."""
    port_errors: tuple[PortErrorReport, ...] = ()
    """Ports whose errors were counted while the master read them."""
    emergencies: int = 0
    """Number since the engine started, or since ForgetFaults."""
    latest_emergencies: tuple[EmergencyReport, ...] = ()
    """The latest, oldest first."""


class EoePortReport(msgspec.Struct, frozen=True, kw_only=True):
    """A slave at the Ethernet switch of its master; frames since services started."""

    station: int
    name: str
    is_connected: bool = False
    """True while its mailbox is open."""
    ip: str = ""
    """Address that it has accepted, empty if none was written."""
    fault: str = ""
    """Reason that its IP settings were not written, or that it has no EoE."""
    received: int = 0
    """Came from the slave."""
    sent: int = 0
    """Went to the slave."""
    dropped: int = 0
    """Not sent, because too many waited, or the slave was not connected."""
    invalid: int = 0
    """Came from the slave with fragments missing, or a wrong length."""
    failed: int = 0
    """Sent, but not taken by the slave."""
    last_error: str = ""
    addresses: tuple[str, ...] = ()
    """MAC addresses behind it."""


class EoeReport(msgspec.Struct, frozen=True, kw_only=True):
    """Ethernet switch of a master, with the TAP interface of the host as one port."""

    interface: str
    address: str
    fault: str
    """Reason that the interface is not open."""
    received: int
    """Frames that came from the host."""
    sent: int
    """Frames that went to the host."""
    dropped: int
    slaves: tuple[EoePortReport, ...]


class RingState(msgspec.Struct, frozen=True, kw_only=True):
    """Ring with a second line to the master; times are ages in nanoseconds."""

    is_whole: bool | None
    """None before the first frame."""
    ends: tuple[int | None, int | None] | None = None
    """Stations before and behind the last cut, None in it for the master; None if not known."""
    silent: tuple[int, ...] = ()
    """Lines (1, 2) whose frames do not come back at all."""
    cuts: int = 0
    cut_ns: int | None = None
    """Age of the last cut."""
    mended_ns: int | None = None


class LockState(msgspec.Struct, frozen=True, kw_only=True):
    """Lock of the cycle to the reference clock of the bus; times in nanoseconds."""

    reference: int | None
    """Station address of the slave with that clock; None without one."""
    is_locked: bool
    offset_ns: int
    """Mean offset of the frames from the set point, positive if they come late."""
    drift_ppb: int
    """Drift of the host's clock from the reference, positive if it is fast, in 1e-9."""
    lead_ns: int
    """Set point before SYNC0."""
    late: int
    """Frames that came later than half of the lead while the cycle was locked."""
    early: int
    """Frames that came as much too early."""
    fault_ns: int | None
    """Age of the last of both."""


class BusReport(msgspec.Struct, frozen=True, kw_only=True):
    """Description of a bus; counters since the engine started, times in nanoseconds."""

    is_up: bool
    """True after it has been brought up, in any state of its slaves."""
    fault: str = ""
    """Reason if not."""
    slaves: tuple[SlaveReport, ...] = ()
    refused: tuple[SlaveReport, ...] = ()
    """Slaves that are there instead, while the bus is not as configured."""
    silent_since_ns: int | None = None
    """Nanoseconds since frames stopped coming back, the last time."""
    silent_until_ns: int | None = None
    """Nanoseconds since they came back again."""
    frames_sent: int = 0
    frames_received: int = 0
    frames_late: int = 0
    """Frames that came back after their time-out: the bus or this machine was slow."""
    frames_lost: int = 0
    """Frames that never came back."""
    frames_retried: int = 0
    timeout_ns: int = 0
    """Time-out of the next frame, after which it is sent again."""
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
    ring: RingState | None = None
    """None on a bus with one line."""
    lock: LockState | None = None
    """None if the cycle does not follow the clocks of this bus, or it has no process data yet."""
    malformed: int = 0
    """Malformed messages of services, for all buses of the engine together."""
    dropped: int = 0
    """Replies that services did not take, for all buses of the engine together."""
    eoe: EoeReport | None = None
    """Added by services, where the plant file has a TAP interface for the bus."""


class EngineReply(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True, tag="answer"):
    """Reply to one request: *error*, or what the request names."""

    id: int
    error: ErrorRecord | None = None
    message: MailboxMessage | None = None
    replies: tuple[DatagramReply, ...] = ()
    report: BusReport | None = None


class EngineStarted(msgspec.Struct, frozen=True, tag="hello"):
    """First message of an engine: requests to the one before it are not answered."""

    pid: int


class UnsolicitedMessage(msgspec.Struct, frozen=True, tag="heard"):
    """Message that a slave on a bus sent unasked."""

    bus: int
    message: Unsolicited


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
    is_silent: bool = False
    """True if no frame comes back."""


EngineMessage: TypeAlias = EngineReply | EngineStarted | UnsolicitedMessage | BusChange
