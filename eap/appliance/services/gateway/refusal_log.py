"""Log lines for requests that a gateway refused, with the cause of each."""

from __future__ import annotations

import logging

from eap.aoe.access import host_of
from eap.aoe.way import Way
from eap.appliance.services.log_limits import caused_by
from eap.codec.mailbox import MailboxType
from eap.gateway.refusal import Reason

_LOGGED = frozenset(
    (
        Reason.DENIED,
        Reason.NOT_RECORDED,
        Reason.CROWDED,
        Reason.TOO_FAST,
        Reason.TIMEOUT,
        Reason.BUS_DOWN,
        Reason.UNREACHABLE,
    )
)
"""Reasons that an operator may want to act on; the others are between client and slave."""

logger = logging.getLogger(__name__)


class RefusalLog:
    """The lines of one gateway; *name* is that of the bus port."""

    def __init__(self, name: str) -> None:
        self._name = name

    def write(self, way: Way, address: int, kind: MailboxType, reason: Reason) -> None:
        """Log that a request was refused."""
        if reason not in _LOGGED:
            return
        host = host_of(way)
        cause = self._name, way.door, host, address, kind, reason
        logger.warning(
            "gateway %s: %s of %s (%s) to address %d refused: %s",
            self._name, kind.name, way.connection, way.door, address, reason.text,
            extra=caused_by(cause, f"{self._name} {way.door} {host}"),
        )  # fmt: skip
