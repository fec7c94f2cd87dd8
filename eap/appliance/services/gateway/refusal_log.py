"""Log lines for what a gateway did not do, of each client not too many."""

from __future__ import annotations

import logging
from collections import OrderedDict
from collections.abc import Callable
from time import monotonic

from eap.aoe.access import host_of
from eap.aoe.way import Way
from eap.appliance.services.allowance import Allowance
from eap.codec.mailbox import MailboxType
from eap.gateway.refusal import Reason

BURST = 20
"""Lines that a client may cause at once."""
PER_S = 2
"""And for long."""
MAX_CLIENTS = 256
"""Whose lines are counted apart."""
_TOLD = frozenset((Reason.DENIED, Reason.CROWDED, Reason.TOO_FAST, Reason.TIMEOUT, Reason.BUS_DOWN))
"""What somebody may want to do something about; the rest is between client and slave."""

logger = logging.getLogger(__name__)


class RefusalLog:
    """The lines of one gateway.

    Args:
        name: Of the bus port.
        clock: In seconds.
    """

    def __init__(self, name: str, clock: Callable[[], float] = monotonic) -> None:
        self._name = name
        self._clock = clock
        self._clients: OrderedDict[tuple[str, str], Allowance] = OrderedDict()

    def write(self, way: Way, address: int, kind: MailboxType, reason: Reason) -> None:
        """Say that a request was refused, unless its client has caused many lines just now."""
        if reason not in _TOLD:
            return
        now = self._clock()
        key = way.door, host_of(way)
        client = self._clients.pop(key, None) or Allowance(BURST, PER_S, now)
        if len(self._clients) >= MAX_CLIENTS:
            self._clients.popitem(last=False)
        self._clients[key] = client
        if not client.take(now):
            client.skipped += 1
            return
        more = f"; {client.skipped} lines like it left out" if client.skipped else ""
        client.skipped = 0
        logger.warning(
            "gateway %s: %s of %s (%s) to address %d refused: %s%s",
            self._name, kind.name, way.connection, way.door, address, reason.text, more,
        )  # fmt: skip
