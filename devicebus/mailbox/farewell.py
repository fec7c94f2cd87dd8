"""What ends a transfer in a slave's mailbox for somebody who has left in the middle of it.

A slave that knows of no transfer ignores it, so it may be sent whenever that is not known.
"""

from __future__ import annotations

from devicebus.mailbox.conversation import MailboxRequest
from eap.codec import foe
from eap.codec.mailbox import MailboxType
from eap.codec.sdo import encode_abort
from eap.od.abort import AbortCode

_TIMEOUT_NS = 50_000_000
"""A slave that does not take messages shall not keep others waiting for this one."""

FAREWELLS = {
    MailboxType.COE: MailboxRequest(
        MailboxType.COE,
        encode_abort(0, 0, AbortCode.GENERAL),
        timeout_ns=_TIMEOUT_NS,
        expects_reply=False,
    ),
    MailboxType.FOE: MailboxRequest(
        MailboxType.FOE,
        foe.encode_message(foe.FoeOpcode.ERROR, foe.FoeErrorCode.NOT_DEFINED),
        timeout_ns=_TIMEOUT_NS,
        expects_reply=False,
    ),
}
"""By protocol; others have no transfers that stay open."""
