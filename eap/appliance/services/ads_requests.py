"""ADS requests answered by whoever cannot do so at once: one operation after the other."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from typing import TypeAlias

from eap.aoe.ads_device import Judge, allow
from eap.aoe.ads_operation import Operation, OperationOutcome
from eap.aoe.ads_request import AdsRequest, Outcomes, take_request
from eap.aoe.answer import AmsAnswer

_AT_ONCE = 64
"""Operations of a sum command after which others have a turn."""

Perform: TypeAlias = Callable[[Operation], Awaitable[OperationOutcome]]


async def answer_request(
    command: int, body: bytes, perform: Perform, *, judge: Judge = allow
) -> AmsAnswer:
    """Have *perform* do what a request asks for, as far as *judge* has nothing against it.

    Args:
        command: Of the AMS header.
        body: What follows the header.
        perform: Does one operation.
        judge: Looks at each operation, also at those of a sum command.
    """
    request = take_request(command, body)
    if isinstance(request, AmsAnswer):
        return request
    return await answer_in_steps(request, perform, judge)


async def answer_in_steps(request: AdsRequest, perform: Perform, judge: Judge) -> AmsAnswer:
    """Do as :func:`answer_request` with a request that has been taken apart."""
    outcomes = Outcomes(request)
    for number, operation in enumerate(request.operations, start=1):
        reason = judge(operation)
        outcomes.add(OperationOutcome(reason) if reason else await perform(operation))
        if not number % _AT_ONCE:
            await asyncio.sleep(0)
    return outcomes.answer()
