"""What a master tells its user; *at_ns* is the time at which it noticed."""

from __future__ import annotations

from typing import TypeAlias

import msgspec

from devicebus.master.mailboxes import Unsolicited


class SlaveLost(msgspec.Struct, frozen=True):
    """A slave does not answer any more."""

    station: int
    at_ns: int


class SlaveLeft(msgspec.Struct, frozen=True):
    """A slave has left its state by itself; *status* and *code* as in its AL status."""

    station: int
    status: int
    code: int
    at_ns: int


class SlaveBack(msgspec.Struct, frozen=True):
    """A slave is back in the state where it belongs, so long after it was missed."""

    station: int
    duration_ns: int
    at_ns: int


class SlaveFailed(msgspec.Struct, frozen=True):
    """A slave could not be brought back; it is tried again."""

    station: int
    reason: str
    at_ns: int


class BusLost(msgspec.Struct, frozen=True):
    """No frame comes back."""

    at_ns: int


class BusBack(msgspec.Struct, frozen=True):
    """Frames come back again."""

    at_ns: int


Event: TypeAlias = SlaveLost | SlaveLeft | SlaveBack | SlaveFailed | BusLost | BusBack | Unsolicited
