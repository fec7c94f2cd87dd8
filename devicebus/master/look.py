"""Looking into all mailboxes at once for what slaves send unasked (ETG.1000.4, sync manager 1)."""

from __future__ import annotations

from devicebus.errors import FrameLostError
from devicebus.master.access import fprd
from devicebus.master.bus import Bus
from devicebus.master.mailboxport import STATUS
from devicebus.master.procedure import Procedure
from devicebus.wire.register import SmStatus

_PER_STEP = 15
"""As many as share one frame."""


def look_around(bus: Bus) -> Procedure[None]:
    """Have the mailboxes read that are full and that nobody is busy with."""
    idle = [unit.mailbox for unit in bus.units.values() if unit.mailbox is not None]
    idle = [mailbox for mailbox in idle if not mailbox.is_busy]
    for start in range(0, len(idle), _PER_STEP):
        part = idle[start : start + _PER_STEP]
        try:
            replies, now_ns = yield [fprd(each.station, STATUS, 1, tries=1) for each in part]
        except FrameLostError:
            continue  # the next look comes soon
        for mailbox, reply in zip(part, replies, strict=True):
            if reply.wkc and reply.data[0] & SmStatus.MAILBOX_FULL:
                mailbox.look(now_ns)
