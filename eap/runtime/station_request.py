"""Requests of services to the engine for a station, on the pair that carries those to buses."""

from __future__ import annotations

from typing import TypeAlias

import msgspec


class StationMessage(msgspec.Struct, frozen=True, kw_only=True, tag_field="do"):
    """Base of both; answered without anything, or with a failure."""

    id: int
    """Chosen by who asks; the answer repeats it."""
    station: str


class Configure(StationMessage, frozen=True, tag="configure"):
    """Run another specification: answered when its first cycle is the next one."""

    path: str
    """A file with the StationSpec in lines (``pieces.to_lines``), there until the answer."""


class SetState(StationMessage, frozen=True, tag="set_state"):
    """Go to a device state, by all states between."""

    state: int
    """2 PreOp, 4 SafeOp, 8 Op."""


StationRequest: TypeAlias = Configure | SetState
