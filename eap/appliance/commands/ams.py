"""Requests through the routers of running appliances, as a command makes them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any, TypeVar

from eap.appliance.commands.client import Client, connect
from eap.appliance.control import ErrorCode
from eap.errors import ControlError

T = TypeVar("T")

TRACE_S = 60.0
SCAN_S = 120.0
"""Patience: a scan asks every station, and who is dead takes his time."""


def trace(target: str, plant: str | None = None, via: str | None = None) -> dict[str, Any]:
    """Return the way to *target*, hop by hop.

    Args:
        target: ``STATION[/PORT[/SLAVE]]`` or ``NETID[:PORT]``.
        plant: Of the appliance that asks; None for the first that knows the target.
        via: Station whose router asks; None for the first of the appliance.

    Raises:
        ControlError: there is no such target or station, or nobody answers.
    """
    return _ask_first(plant, via, "trace", TRACE_S, target=target)


def scan(plant: str | None = None, via: str | None = None) -> list[dict[str, Any]]:
    """Return what is behind each plant that runs here: one answer a plant.

    Raises:
        ControlError: nothing runs, or it does not answer.
    """
    answers: dict[str, dict[str, Any]] = {}
    with ExitStack() as stack:
        for client in [stack.enter_context(each) for each in connect(plant, via)]:
            if client.info.plant not in answers:
                answers[client.info.plant] = client.request_within(SCAN_S, "scan", via=via or "")
    return list(answers.values())


def _ask_first(
    plant: str | None, via: str | None, method: str, patience_s: float, **params: Any
) -> dict[str, Any]:
    def ask(client: Client) -> dict[str, Any]:
        answer: dict[str, Any] = client.request_within(patience_s, method, via=via or "", **params)
        return answer

    with first_that_knows(ask, plant, via) as (_, answer):
        return answer


@contextmanager
def first_that_knows(
    ask: Callable[[Client], T], plant: str | None, via: str | None = None
) -> Iterator[tuple[Client, T]]:
    """Ask one appliance after the other; give the first that knows the names, and its answer.

    Args:
        ask: Raises ControlError where a name is not known.
        plant: Of the appliance; None for any.
        via: Station that has to run there; None for any.

    Raises:
        ControlError: nothing runs, nobody knows the names, or *ask* failed in another way.
    """
    unknown: ControlError | None = None
    with ExitStack() as stack:
        for client in [stack.enter_context(each) for each in connect(plant, via)]:
            try:
                answer = ask(client)
            except ControlError as exc:
                if exc.code != ErrorCode.UNKNOWN_NAME:
                    raise
                unknown = unknown or exc
            else:
                yield client, answer
                return
    assert unknown is not None  # noqa: S101  connect() found at least one
    raise unknown
