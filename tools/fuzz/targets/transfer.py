"""What a gateway makes of requests and replies: what runs, what a request does, and why not."""

from __future__ import annotations

from itertools import cycle

from devicebus.mailbox.protocol import MailboxSizes
from eap.aoe.way import Way
from eap.codec.mailbox import MailboxType
from eap.gateway.ledger import Admission, ClientLimits, Ledger
from eap.gateway.refusal import Reason, refuse
from eap.gateway.rights import operation_of
from eap.gateway.transfer import Transfer
from tools.fuzz.messages import cut

_WAYS = tuple(Way("door", str(number)) for number in range(5))
_REASONS = tuple(Reason)


def fuzz_one(data: bytes) -> None:
    """Follow a transfer in every protocol, whatever both sides say; nothing may be raised."""
    messages = list(cut(data))
    for kind in MailboxType:
        transfer = Transfer(kind, MailboxSizes(24, 20))
        for number, (body, is_request) in enumerate(zip(messages, cycle((True, True, False)))):
            if not is_request:
                transfer.answer(body)
                continue
            operation_of(kind, body)
            answer = refuse(kind, body, _REASONS[number % len(_REASONS)])
            if answer.type not in {kind, MailboxType.ERR} or not answer.body:
                raise AssertionError(f"{kind.name}: {answer}")
            if not transfer.is_repeated(body):
                transfer.ask(body)
        transfer.end()
        if transfer.is_running:
            raise AssertionError("it runs on after its end")
    _keep_books(messages)


def _keep_books(messages: list[bytes]) -> None:
    """Admit and answer requests of more clients than there is room for."""
    limits = ClientLimits(in_flight=2, rate=3, clients=3, in_flight_in_all=4)
    ledger = Ledger(limits)
    waiting: list[tuple[Way, bytes]] = []
    for number, body in enumerate(messages):
        way = _WAYS[len(body) % len(_WAYS)]
        if ledger.admit(way, body, number) is Admission.TAKEN:
            waiting.append((way, body))
        if len(waiting) > limits.in_flight_in_all:
            raise AssertionError(f"{len(waiting)} requests wait")
        if number % 3 == 0 and waiting:
            ledger.answered(*waiting.pop(0))
    for way, body in waiting:
        ledger.answered(way, body)
    if any(ledger.waiting(way) for way in _WAYS) or len(ledger.table()) > limits.clients:
        raise AssertionError("clients or requests are left over")
