"""Triggers of TxPDs.  docs/triggers.md holds the truth table that this file follows.

Rule 1: a frame's divider is a gate; nothing of the frame is sent while it is closed.  Events and
changes of that time wait for it; cycle time and divider only count in the cycles that it lets by.
Rule 2: when several reasons hold at once the PD is sent once, for the first of: event, cycle or
divider, change, change time-out.
Rule 3: suppression beats every reason; what was due then counts as skipped, an event is used up.
"""

from __future__ import annotations

from typing import NamedTuple

from eap.pd.spec import TriggerSpec
from eap.pd.words import REASON_INDEX, Reason

SUPPRESS_BIT = 1
EVENT_BIT = 2

_CYCLE = REASON_INDEX[Reason.CYCLE]
_DIVIDER = REASON_INDEX[Reason.DIVIDER]
_CHANGE = REASON_INDEX[Reason.CHANGE]
_CHANGE_TIMEOUT = REASON_INDEX[Reason.CHANGE_TIMEOUT]
_EVENT = REASON_INDEX[Reason.EVENT]


class Schedule(NamedTuple):
    """Due in each cycle whose counter leaves *phase* when divided by *step*."""

    step: int
    phase: int
    reason: int
    """Index into REASONS."""

    def is_due(self, cycle: int) -> bool:
        """Tell whether *cycle* is one of them."""
        return cycle % self.step == self.phase


def plan_schedule(trigger: TriggerSpec, cycle_us: int, gate: tuple[int, int]) -> Schedule | None:
    """Return the fixed schedule of a PD, None when only changes or events send it.

    Args:
        trigger: The PD's triggers.
        cycle_us: The device cycle.
        gate: Divider and modulo of its frame; divider 0 is no gate.
    """
    if trigger.cycle_us:
        return Schedule(trigger.cycle_us // cycle_us, 0, _CYCLE)
    if trigger.divider:
        return Schedule(trigger.divider, trigger.modulo, _DIVIDER)
    if trigger.on_change is not None or trigger.event:
        return None
    if gate[0]:
        return Schedule(gate[0], gate[1], _DIVIDER)
    return Schedule(1, 0, _CYCLE)


class Trigger:
    """The triggers of one PD at run time."""

    __slots__ = (
        "_event",
        "_inhibit_ns",
        "_on_change",
        "_sent_at_ns",
        "_sent_data",
        "_sent_for_change_ns",
        "_timeout_ns",
        "schedule",
        "suppressed",
        "takes_events",
    )

    def __init__(self, spec: TriggerSpec, schedule: Schedule | None) -> None:
        self.schedule = schedule
        self.suppressed = False
        self.takes_events = spec.event
        self._event = False
        self._on_change = spec.on_change is not None
        self._timeout_ns = spec.on_change.timeout_ms * 1_000_000 if spec.on_change else 0
        self._inhibit_ns = spec.on_change.inhibit_us * 1_000 if spec.on_change else 0
        self._sent_data: bytes | None = None
        self._sent_at_ns = 0
        self._sent_for_change_ns: int | None = None

    @property
    def wants_data(self) -> bool:
        """True if :meth:`reason` has to see the data."""
        return self._on_change

    def raise_event(self) -> None:
        """Ask for the PD to be sent at the next opportunity."""
        self._event = True

    def reason(self, cycle: int, now_ns: int, data: bytes | None) -> int | None:
        """Return the index of the reason to send now, None if there is none.

        Args:
            cycle: The station's cycle counter; the frame's gate is open in it.
            now_ns: The current time.
            data: What would be sent; only looked at by an on-change trigger.
        """
        if self._event:
            return _EVENT
        if self.schedule is not None and self.schedule.is_due(cycle):
            return self.schedule.reason
        if not self._on_change:
            return None
        if data != self._sent_data:
            last_ns = self._sent_for_change_ns
            if last_ns is None or now_ns - last_ns >= self._inhibit_ns:
                return _CHANGE
        elif self._timeout_ns and now_ns - self._sent_at_ns >= self._timeout_ns:
            return _CHANGE_TIMEOUT
        return None

    def use_up_event(self) -> None:
        """Forget a raised event: the PD was sent, or skipped while suppressed."""
        self._event = False

    def sent(self, reason: int, now_ns: int, data: bytes | None) -> None:
        """Note that the PD went out for *reason*."""
        self._event = False
        self._sent_at_ns = now_ns
        self._sent_data = data
        if reason == _CHANGE:
            self._sent_for_change_ns = now_ns

    def forget(self) -> None:
        """Begin as at a start: an event is gone, and a change is what comes first."""
        self._event = False
        self._sent_data = None

    def follow(self, before: Trigger, *, is_same: bool) -> None:
        """Go on where *before* was; *is_same* tells that the PD is still sent as it was.

        If it is not, no subscriber has its data yet, and an on-change trigger sends it.
        """
        self._event = before._event and self.takes_events
        self._sent_at_ns = before._sent_at_ns
        self._sent_for_change_ns = before._sent_for_change_ns
        self._sent_data = before._sent_data if is_same else None
