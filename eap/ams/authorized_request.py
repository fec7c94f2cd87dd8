"""Requests that were let through because of the access rules, and what came of them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from eap.ads.endpoint import Endpoint
from eap.ads.operation import Operation, OperationOutcome
from eap.ads.part import encode_sum, part_of, split_answer
from eap.ads.request import AdsRequest
from eap.ams.access import Decision
from eap.ams.spec import AccessService
from eap.codec.ads import AdsError, IndexGroup
from eap.codec.ams import AmsHeader

_DENIED = OperationOutcome(AdsError.ACCESS_DENIED)
_RESULT = 4


class AddRoute(NamedTuple):
    """A route that somebody asked for by UDP 48899; *user* is who he says he is."""

    name: str
    net_id: str
    address: str
    user: str


class AuditedOperation(NamedTuple):
    """One operation, what was decided on it, and how it came out."""

    operation: Operation | AddRoute
    decision: Decision
    result: int | None
    """None if nobody knows: there was no answer, or none that can be read."""

    @property
    def is_told(self) -> bool:
        """Whether an audit tells of it: it changed something, or was refused."""
        if not self.decision.is_allowed:
            return True
        if self.decision.service is AccessService.READ:
            return False
        # Of a file the opening is told; a megabyte of it is a thousand writes.
        is_piece = getattr(self.operation, "group", None) == IndexGroup.FOE_WRITE
        return not is_piece or bool(self.result)


class AuditEntry(NamedTuple):
    """What somebody had changed, or wanted to."""

    endpoint: Endpoint
    header: AmsHeader
    """Of the request, as it came."""
    route: str
    """Name of the route that it went on by; empty for what is of this station."""
    operations: tuple[AuditedOperation, ...]


class AuthorizedRequest(NamedTuple):
    """A request and what was decided on its operations."""

    endpoint: Endpoint
    header: AmsHeader
    route: str
    """As in the audit."""
    request: AdsRequest
    decisions: tuple[Decision, ...]

    @property
    def refused(self) -> list[Decision]:
        """The verdicts on what may not be done."""
        return [each for each in self.decisions if not each.is_allowed]

    @property
    def changes(self) -> AuditEntry:
        """Entry of the changes in the request that are allowed; none of them is done yet."""
        entry = self._entry([None] * len(self.decisions))
        allowed = tuple(each for each in entry.operations if each.decision.is_allowed)
        return entry._replace(operations=allowed)

    def refuse_changes(self, why: str) -> AuthorizedRequest:
        """Return the request with all that changes something refused."""
        return self._replace(
            decisions=tuple(
                each
                if each.service is AccessService.READ or not each.is_allowed
                else each._replace(is_allowed=False, why=why)
                for each in self.decisions
            )
        )

    def encode_part(self) -> bytes:
        """Return the body of a sum command with what may be done."""
        return encode_sum(self._part())

    def take_answer(self, error_code: int, body: bytes) -> tuple[bytes, AuditEntry]:
        """Return the answer to the whole of the request, and what the audit says of it.

        Args:
            error_code: Of the AMS header of the answer.
            body: Of the answer to what went on.
        """
        part = self._part()
        results: list[int | None] = [error_code or _first_result(body)] * len(part.operations)
        outcomes = split_answer(part, body) if part.sum_group and not error_code else None
        if outcomes is not None:
            results = [each.result for each in outcomes]
            if self.refused:
                left = iter(outcomes)
                body = self.request.encode_answer(
                    [next(left) if each.is_allowed else _DENIED for each in self.decisions]
                )
        return body, self._entry(results)

    def give_up(self, error_code: int | None) -> AuditEntry:
        """Return what the audit says of a request that nothing came back for.

        Args:
            error_code: That its client got; None if it got nothing.
        """
        return self._entry([error_code] * len(self.decisions))

    def _part(self) -> AdsRequest:
        if not self.refused:
            return self.request
        pairs = zip(self.request.operations, self.decisions, strict=True)
        return part_of(self.request, [each for each, decision in pairs if decision.is_allowed])

    def _entry(self, results: Sequence[int | None]) -> AuditEntry:
        """Return an entry; *results* are those of what was allowed."""
        left = iter(results)
        operations = (
            AuditedOperation(
                operation, decision, next(left) if decision.is_allowed else _DENIED.result
            )
            for operation, decision in zip(self.request.operations, self.decisions, strict=True)
        )
        told = tuple(each for each in operations if each.is_told)
        return AuditEntry(self.endpoint, self.header, self.route, told)


def _first_result(body: bytes) -> int | None:
    return int.from_bytes(body[:_RESULT], "little") if len(body) >= _RESULT else None
