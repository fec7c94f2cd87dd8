"""The control protocol's words about AMS: ways, what is behind them, and requests to anybody.

docs/control.md is their description.
"""

from __future__ import annotations

from typing import Annotated, Any

from msgspec import Meta

from eap.aoe.hop_report import HopReport
from eap.appliance.control import Parameters

MAX_TIMEOUT_MS = 60_000


class ViaParameters(Parameters, frozen=True, kw_only=True):
    """Base: *via* is the station whose router asks; empty for the first one here."""

    via: str = ""


class ScanParameters(ViaParameters, frozen=True, kw_only=True):
    """``scan``."""


class TraceParameters(ViaParameters, frozen=True, kw_only=True):
    """``trace``: *target* is ``STATION[/PORT[/SLAVE]]`` or ``NETID[:PORT]``."""

    target: str


class AskParameters(TraceParameters, frozen=True, kw_only=True):
    """``ams_ask``: one ADS request; *data* is what follows the header, in hexadecimal digits.

    With *device* a station stands for its first EAP port, not for its router.
    """

    command: Annotated[int, Meta(ge=1, le=0xFFFF)]
    data: str = ""
    device: bool = False
    timeout_ms: Annotated[int, Meta(ge=1, le=MAX_TIMEOUT_MS)] = 5000


def hop_row(report: HopReport, took_us: int, spent_us: int, *, is_opaque: bool) -> dict[str, Any]:
    """Return one router of a way; *spent_us* is the part of *took_us* behind the router before."""
    return {
        "station": report.station,
        "net_id": report.net_id,
        "opaque": is_opaque,
        "route": report.route,
        "door": report.door,
        "address": report.address,
        "state": report.state,
        "why": report.why,
        "interrupted": report.interrupted,
        "interrupted_s": report.interrupted_s,
        "may": {str(service): allowed for service, allowed in report.may.items()},
        "took_us": took_us,
        "spent_us": spent_us,
    }
