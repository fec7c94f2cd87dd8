"""Access rules at a gateway, and the audit of its changes and refusals.

One line of the audit is written for each change, when it is known how it came out and before its
client has the answer, and one for each refusal.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import msgspec

from eap.ads.request import Operation, Read
from eap.ams.access import AccessList, AuditedOperation, AuditEntry, Decision
from eap.ams.spec import AccessService
from eap.codec.ads import AdsError
from eap.codec.ams import AmsHeader
from eap.gateway.error_table import Cause
from eap.gateway.requests import error_in
from eap.ids import Endpoint, NetId
from eap.services.gateway.sessions import GatewayReply

NO_SOURCE = NetId(bytes(6))
"""Source NetID of clients, which have none here."""
MASTER_PORT = 0xFFFF
"""AMS port by which rules name the master itself."""


class RuleTarget(NamedTuple):
    """Name of a slave in access rules: a NetID and an AMS port, which is 0xFFFF for a master."""

    net_id: NetId
    port: int


class RequestDecision(msgspec.Struct, frozen=True):
    """Decision on a request.

    Attributes:
        station: Mailbox address that is counted.
        target: Its name in access rules.
        operation: None for a request that needs no decision: a step of a transfer that was
            decided at its start, or a read where everything may be read.
        decision: Likewise.
    """

    station: int
    target: RuleTarget
    operation: Operation | None
    decision: Decision | None

    @property
    def is_allowed(self) -> bool:
        """True if it may be done."""
        return self.decision is None or self.decision.is_allowed


class GatewayAdmission:
    """Access decisions on gateway requests.

    Args:
        access: Returns the rules that are in force.

    Attributes:
        on_audit: Called with what was changed, and what was refused.
        before_change: Called with each change before it is done, where changes that cannot be
            recorded are refused: returns why it cannot be, empty if it was.
    """

    def __init__(self, access: Callable[[], AccessList]) -> None:
        self.on_audit: list[Callable[[AuditEntry], None]] = []
        self.before_change: Callable[[AuditEntry], str] | None = None
        self._access = access

    def may_read(self, endpoint: Endpoint, target: RuleTarget, operation: Operation) -> bool:
        """Return whether an operation is a read where the client may read everything."""
        # Reads are most of the traffic: where all may be read, no decision object is made.
        if not isinstance(operation, Read):
            return False
        return self._access().grants(endpoint, NO_SOURCE, *target).may_read

    def decide(
        self, endpoint: Endpoint, target: RuleTarget, operation: Operation, *, by_rule: bool = False
    ) -> Decision:
        """Decide on an operation; *by_rule*: a change only if a rule says so."""
        decision = self._access().grants(endpoint, NO_SOURCE, *target).decide(operation)
        # A default permission is meant for one slave; a group write changes all of them at once.
        if by_rule and decision.service is not AccessService.READ and not decision.is_by_rule:
            why = "only a rule allows it for several slaves at once"
            return decision._replace(is_allowed=False, why=why)
        return self._record_intent(endpoint, target, operation, decision)

    def _record_intent(
        self, endpoint: Endpoint, target: RuleTarget, operation: Operation, decision: Decision
    ) -> Decision:
        """Return the verdict on a change when it has been recorded, where that is required."""
        change = AuditedOperation(operation, decision, None)
        is_change = decision.is_allowed and change.is_audited
        if self.before_change is None or not is_change:
            return decision
        why = self.before_change(_entry(endpoint, target, change))
        if not why:
            return decision
        return decision._replace(is_allowed=False, is_recordable=False, why=why)

    def record(
        self,
        endpoint: Endpoint,
        target: RuleTarget,
        operation: Operation,
        decision: Decision,
        result: int | None,
    ) -> None:
        """Write a decision and the result of the operation to the audit.

        Args:
            endpoint: Connection, or address, of the client.
            target: Its name in access rules.
            operation: What was to be done.
            decision: Whether it may be.
            result: An error of ADS, 0 for none, None if it is unknown.
        """
        if not decision.is_allowed:
            result = AdsError.ACCESS_DENIED
        audited = AuditedOperation(operation, decision, result)
        if audited.is_audited:
            for write in self.on_audit:
                write(_entry(endpoint, target, audited))


def _entry(endpoint: Endpoint, target: RuleTarget, audited: AuditedOperation) -> AuditEntry:
    return AuditEntry(endpoint, AmsHeader(*target, NO_SOURCE, 0, 0), "", (audited,))


def denial_cause(decision: Decision | None) -> Cause:
    """Return why a request with this verdict is refused."""
    is_recordable = decision is None or decision.is_recordable
    return Cause.DENIED if is_recordable else Cause.NOT_RECORDED


def result_of(replies: Sequence[GatewayReply]) -> int | None:
    """Return the result for the audit of a request, from its replies, as an error of ADS."""
    if not replies:
        return None
    reply = replies[-1]
    return error_in(reply.type, reply.body) if reply.reason is None else reply.reason.value.ads
