"""Requests to a gateway as access rules, error answers and statistics of clients see them."""

from __future__ import annotations

from eap.codec.mailbox import MailboxType
from eap.gateway.error_table import Cause
from eap.gateway.request_tracker import ClientLimits, RequestAdmission, RequestTracker
from eap.gateway.requests import error_reply, operation_of
from eap.ids import Endpoint
from tools.fuzz.messages import cut

_WAYS = tuple(Endpoint("door", str(number)) for number in range(5))
_CAUSES = tuple(Cause)


def fuzz_one(data: bytes) -> None:
    """Refuse requests of every protocol, whatever they say; nothing may be raised."""
    messages = list(cut(data))
    for kind in MailboxType:
        for number, body in enumerate(messages):
            operation_of(kind, body)
            answer = error_reply(kind, body, _CAUSES[number % len(_CAUSES)])
            if answer.type not in {kind, MailboxType.ERR} or not answer.body:
                raise AssertionError(f"{kind.name}: {answer}")
    _check_accounting(messages)


def _check_accounting(messages: list[bytes]) -> None:
    """Admit and answer requests of more clients than there is room for."""
    limits = ClientLimits(in_flight=2, rate=3, clients=3, in_flight_in_all=4)
    tracker = RequestTracker(limits)
    waiting: list[tuple[Endpoint, bytes]] = []
    for number, body in enumerate(messages):
        endpoint = _WAYS[len(body) % len(_WAYS)]
        if tracker.admit(endpoint, body, number) is RequestAdmission.TAKEN:
            waiting.append((endpoint, body))
        if len(waiting) > limits.in_flight_in_all:
            raise AssertionError(f"{len(waiting)} requests wait")
        if number % 3 == 0 and waiting:
            tracker.answered(*waiting.pop(0))
    for endpoint, body in waiting:
        tracker.answered(endpoint, body)
    if (
        any(tracker.waiting(endpoint) for endpoint in _WAYS)
        or len(tracker.table()) > limits.clients
    ):
        raise AssertionError("clients or requests are left over")
