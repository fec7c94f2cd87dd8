"""Taking over the mailbox of a slave from whoever used it before.

A slave drops a message with the counter of the one before (ETG.1000.4), and nobody can ask it which
that was.  So the first message is one that needs no answer: dropped or not, the next one is new.

With CoE it is a request that every slave knows.  An abort would ask for no answer at all, but
slaves are in use that take one for a request which they never finish, and are deaf from then on.
"""

from __future__ import annotations

from devicebus.errors import BusError
from devicebus.mailbox.conversation import Conversation, MailboxRequest
from devicebus.master.bring import bring, wait_for
from devicebus.master.bus import BusSlave, BusState
from devicebus.master.mailboxes import Mailbox
from devicebus.master.mailboxport import MailboxArea
from devicebus.master.procedure import Procedure, Sleep, read
from devicebus.wire.alstatus import AlState, state_name
from devicebus.wire.register import Register, SyncManager
from devicebus.wire.sii import SiiProtocol
from eap.codec import foe, soe
from eap.codec.coe import CoeService, SdoRequest, encode_message, encode_plain
from eap.codec.mailbox import MailboxType, VoeHeader

SETTLE_NS = 2_000_000
"""How long an answer to the first message is waited for, to be thrown away."""
_MAILBOX_MODE = 2
_DEVICE_TYPE = 0x1000


def attach(bus: BusState, slave: BusSlave) -> Procedure[Mailbox]:
    """Return the open mailbox of a slave, which is brought to PREOP if it is in INIT.

    Raises:
        BusError: it has none that can be.
        AlStatusError: it refuses PREOP.
        WorkingCounterError: it does not answer.
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
    """Throw away what waits in the mailbox, and use up one counter."""
    mailbox = _opened(slave)
    _, now_ns = yield Sleep(0)
    mailbox.poll(now_ns)
    greeting = _send_first_message(SiiProtocol(slave.found.sii.fixed.protocols), slave.state)
    yield from wait_for(mailbox.converse(greeting, now_ns, name="greeting", requester=bus))
    for _ in range(2):
        _, now_ns = yield Sleep(SETTLE_NS // 2)
        mailbox.poll(now_ns)


def _send_first_message(protocols: SiiProtocol, state: AlState | None) -> Conversation[None]:
    """Send what changes nothing, in a protocol that the slave knows; an answer is thrown away."""
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
        yield MailboxRequest(MailboxType.VOE, VoeHeader(0, 0).encode(), expects_reply=False)
