"""Procedure that takes over the mailbox of a slave from another master.

A slave drops a message with the counter of the message before (ETG.1000.4), and that counter cannot
be read.  The first message therefore needs no answer: whether the slave drops it or not, the
counter of the second message is new.

With CoE the first message is an upload of 0x1000, which every slave supports.  An abort would need
no answer at all, but some slaves handle it as a request that they never finish and stop answering.
"""

from __future__ import annotations

from devicebus.errors import BusError
from devicebus.mailbox.conversation import Conversation, MailboxRequest
from devicebus.master.bring import bring
from devicebus.master.bus import BusSlave, BusState
from devicebus.master.configuration import wait_for
from devicebus.master.mailboxes import Mailbox, MailboxArea
from devicebus.master.procedure import Procedure, Sleep, read
from devicebus.wire.alstatus import AlState, state_name
from devicebus.wire.register import Register, SyncManager
from devicebus.wire.sii import SiiProtocol
from eap.codec import foe, soe
from eap.codec.coe import CoeService, SdoRequest, encode_message, encode_plain
from eap.codec.mailbox import MailboxType, VoeHeader

SETTLE_NS = 2_000_000
"""Wait for an answer to the first message, which is discarded."""
_MAILBOX_MODE = 2
_DEVICE_TYPE = 0x1000


def attach(bus: BusState, slave: BusSlave) -> Procedure[Mailbox]:
    """Return the open mailbox of a slave; a slave in INIT is brought to PREOP.

    Raises:
        BusError: the slave has no usable mailbox.
        AlStatusError: the slave refuses PREOP.
        WorkingCounterError: the slave does not answer.
    """
    if slave.state is AlState.INIT:
        yield from bring(bus, slave, AlState.PREOP)
        return _opened(slave)
    octets = yield from read(
        slave.station, Register.SYNC_MANAGER, 2 * SyncManager.SIZE, "sync managers"
    )
    out, back = SyncManager.decode(octets), SyncManager.decode(octets, SyncManager.SIZE)
    if out.mode == back.mode == _MAILBOX_MODE and out.enable and back.enable:
        area = MailboxArea(out.start, out.length, back.start, back.length)
        if area.is_there:
            area.check(slave.station)
            bus.open_mailbox(slave, area)
            yield from _synchronize_counter(bus, slave)
    return _opened(slave)


def _opened(slave: BusSlave) -> Mailbox:
    if slave.mailbox is None:
        raise BusError(
            f"slave {slave.station} ({slave.name}) has no mailbox in {state_name(slave.al_state)}:"
            " nothing but its state, its EEPROM and its registers can be reached"
        )
    return slave.mailbox


def _synchronize_counter(bus: BusState, slave: BusSlave) -> Procedure[None]:
    """Discard waiting messages and send the first message, which uses one counter."""
    mailbox = _opened(slave)
    _, now_ns = yield Sleep(0)
    mailbox.poll(now_ns)
    greeting = _send_first_message(SiiProtocol(slave.found.sii.fixed.protocols), slave.state)
    yield from wait_for(mailbox.converse(greeting, now_ns, name="greeting", requester=bus))
    for _ in range(2):
        _, now_ns = yield Sleep(SETTLE_NS // 2)
        mailbox.poll(now_ns)


def _send_first_message(protocols: SiiProtocol, state: AlState | None) -> Conversation[None]:
    """Send a message without effect in a protocol of the slave; an answer is discarded."""
    if protocols & SiiProtocol.COE and state is not AlState.BOOT:
        body = encode_plain(SdoRequest.UPLOAD, _DEVICE_TYPE, 0)
        request = encode_message(CoeService.SDO_REQUEST, body)
        yield MailboxRequest(MailboxType.COE, request, expects_reply=False)
    elif protocols & SiiProtocol.FOE:
        over = foe.encode_message(foe.FoeOpcode.ERROR, foe.FoeErrorCode.NOT_DEFINED)
        yield MailboxRequest(MailboxType.FOE, over, expects_reply=False)
    elif protocols & SiiProtocol.SOE:
        note = soe.encode_message(soe.SoeOpcode.NOTIFICATION, 0)
        yield MailboxRequest(MailboxType.SOE, note, expects_reply=False)
    else:
        # Any slave takes it: one without VoE answers with a mailbox error, which is discarded.
        yield MailboxRequest(MailboxType.VOE, VoeHeader(0, 0).encode(), expects_reply=False)
