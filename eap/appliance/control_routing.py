"""The control protocol's words about what routers are told; docs/control.md describes them."""

from __future__ import annotations

from typing import Annotated

from msgspec import Meta

from eap.aoe.spec import Record, RoutingSpec
from eap.appliance.control import Parameters


class RoutingExportParameters(Parameters, frozen=True, kw_only=True):
    """``routing_export`` and ``routing_rollback``."""

    station: str


class RoutingPlanParameters(Parameters, frozen=True, kw_only=True):
    """``routing_plan``: what *routing* would change."""

    station: str
    routing: RoutingSpec


class RoutingApplyParameters(Parameters, frozen=True, kw_only=True):
    """``routing_apply``; *cause* as in ``apply``."""

    station: str
    routing: RoutingSpec
    cause: Annotated[str, Meta(max_length=64)] = ""


class RunningRouting(Record, frozen=True, kw_only=True):
    """What the router of a station is told.

    Attributes:
        routing: Routes of the plant file, rules, users, brokers.
        previous: Before the last change; None if there was none.
        cause: Which change that was.
        undone: Whether it was taken back.
    """

    routing: RoutingSpec
    previous: RoutingSpec | None = None
    cause: str = ""
    undone: bool = False


class RoutingDifference(Record, frozen=True, kw_only=True):
    """What differs, a line for each thing, and what of it needs a new start."""

    changes: list[str]
    refused: list[str]
