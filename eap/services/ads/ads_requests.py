"""ADS requests of which some operations take their time: one after the other, and no detour."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Sequence
from typing import TypeAlias

from eap.ads.endpoint import AmsAnswer
from eap.ads.operation import Operation, OperationOutcome
from eap.ads.request import Outcomes, encode_outcome, take_request

_AT_ONCE = 64
"""Operations of a sum command after which others have a turn."""

Perform: TypeAlias = Callable[[Operation], OperationOutcome | Awaitable[OperationOutcome]]
"""Does one operation, at once or by the end of what it returns."""


def begin_answer(command: int, body: bytes, perform: Perform) -> AmsAnswer | Awaitable[AmsAnswer]:
    """Have *perform* do what a request asks for; return the answer, or what is to be awaited.

    Args:
        command: Of the AMS header.
        body: What follows the header.
        perform: Does one operation.
    """
    request = take_request(command, body)
    if isinstance(request, AmsAnswer):
        return request
    if request.sum_group:
        return _go_through(Outcomes(request), request.operations, perform)
    outcome = perform(request.operations[0])
    if isinstance(outcome, OperationOutcome):
        return _encode(command, outcome)
    return _finish(command, outcome)


async def answer_request(command: int, body: bytes, perform: Perform) -> AmsAnswer:
    """Return the answer to a request; the arguments are those of :func:`begin_answer`."""
    answer = begin_answer(command, body, perform)
    return answer if isinstance(answer, AmsAnswer) else await answer


async def _finish(command: int, outcome: Awaitable[OperationOutcome]) -> AmsAnswer:
    return _encode(command, await outcome)


def _encode(command: int, outcome: OperationOutcome) -> AmsAnswer:
    return AmsAnswer(encode_outcome(command, outcome), why=outcome.why)


async def _go_through(
    outcomes: Outcomes, operations: Sequence[Operation], perform: Perform
) -> AmsAnswer:
    for number, operation in enumerate(operations, start=1):
        outcome = perform(operation)
        outcomes.add(outcome if isinstance(outcome, OperationOutcome) else await outcome)
        if not number % _AT_ONCE:
            await asyncio.sleep(0)
    return outcomes.answer()
