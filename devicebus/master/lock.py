"""Lock of the master's cycle to the reference clock of its bus.

The datagram that distributes the time returns, in each cycle, the time at which the frame passed
the reference clock.  Its phase within the cycle is compared with a set point, so that frames come a
fixed time before SYNC0, and the distance to the next cycle is corrected by small steps.

The control loop is of second order (PI).  The integral is the drift between the clock of the host
and the reference; it stays while no time comes, and a cycle without a sample repeats no
proportional step.  With KP = 1/32 and KI = KP²/4 per cycle the loop is critically damped: 1.0 at
the poles, a step of the phase is gone after about 150 cycles, and jitter of single frames is damped
to about a seventh.  An error is limited before it is used, so that one late frame moves little, and
a step is limited, so that other stations and their subscribers see cycles of almost equal length.
"""

from __future__ import annotations

import msgspec

_KP = 1 / 32
_KI = _KP * _KP / 4
_FILTER = 1 / 16
"""Weight of a new error in the offset that is shown."""
_MAX_STEP = 1 / 200
"""Largest proportional step, in cycles."""
_MAX_ERROR = 1 / 16
"""Largest error that is used while locked, in cycles: single frames may be late by far more."""
_MAX_DRIFT = 1e-3
"""Largest drift."""
_LOCKED, _UNLOCKED = 1 / 50, 1 / 8
"""Offset below which the cycle becomes locked, and above which it is not any more, in cycles."""
_MAX_SILENT = 250
"""Cycles without a time after which the cycle is not locked any more."""
_LEAD = 0.3
"""Default for the set point before SYNC0, in cycles."""


class LockReport(msgspec.Struct, frozen=True, kw_only=True):
    """State of the lock; times in nanoseconds."""

    is_locked: bool
    offset_ns: int
    """Mean offset of the frames from the set point, positive if they come late."""
    drift_ppb: int
    """Drift of the host's clock from the reference, positive if it is fast, in 1e-9."""
    lead_ns: int
    """Set point before SYNC0."""
    samples: int
    late: int
    """Frames that came later than half of the lead while the cycle was locked."""
    early: int
    """Frames that came as much too early."""
    fault_ns: int | None
    """Time of the last of both, None before the first."""


class CycleLock:
    """Control loop of one bus.

    Args:
        cycle_ns: Nominal cycle.
        lead_ns: Time before SYNC0 at which frames pass the reference clock; 0 for the default.
        shift_ns: Smallest shift of a SYNC0 from the start of the common cycle.
    """

    def __init__(self, cycle_ns: int, lead_ns: int = 0, shift_ns: int = 0) -> None:
        self._cycle_ns = cycle_ns
        self._lead_ns = lead_ns or round(_LEAD * cycle_ns)
        self._set_point_ns = shift_ns - self._lead_ns
        self._drift = 0.0  # in nanoseconds per cycle
        self._step = 0.0
        self._rest = 0.0
        self._offset: float | None = None
        self._is_locked = False
        self._samples = self._silent = self._late = self._early = 0
        self._fault_ns: int | None = None

    def note(self, time_ns: int, now_ns: int) -> None:
        """Note that a frame passed the reference clock at *time_ns*, by that clock."""
        cycle_ns = self._cycle_ns
        half_ns = cycle_ns // 2
        error = float((time_ns - self._set_point_ns + half_ns) % cycle_ns - half_ns)
        self._samples += 1
        self._silent = 0
        self._check_window(error, now_ns)
        if self._is_locked:
            limit = _MAX_ERROR * cycle_ns
            error = min(max(error, -limit), limit)
        offset = error if self._offset is None else self._offset + _FILTER * (error - self._offset)
        self._offset = offset
        if abs(offset) > _UNLOCKED * cycle_ns:
            self._is_locked = False
        elif abs(offset) < _LOCKED * cycle_ns and self._samples > 1 / _FILTER:
            self._is_locked = True
        step = -_KP * error
        limit = _MAX_STEP * cycle_ns
        if abs(step) < limit:  # while the step is limited the integral would wind up
            limit_drift = _MAX_DRIFT * cycle_ns
            self._drift = min(max(self._drift - _KI * error, -limit_drift), limit_drift)
        self._step = min(max(step, -limit), limit)

    def hold(self) -> None:
        """Note that there is no reference clock: the cycle keeps its corrected length."""
        self._is_locked = False
        self._offset = None
        self._step = 0.0
        self._samples = 0

    def take_step(self) -> int:
        """Return the distance from the present cycle to the next in ns."""
        # The rest below a nanosecond is carried on: at 1 ms it would be 1 ppm.
        self._silent += 1
        if self._silent > _MAX_SILENT:
            self.hold()
        exact = self._cycle_ns + self._drift + self._step + self._rest
        self._step = 0.0
        step_ns = round(exact)
        self._rest = exact - step_ns
        return step_ns

    def report(self) -> LockReport:
        """Return a snapshot of the state."""
        return LockReport(
            is_locked=self._is_locked,
            offset_ns=round(self._offset or 0.0),
            drift_ppb=round(self._drift / self._cycle_ns * 1e9),
            lead_ns=self._lead_ns,
            samples=self._samples,
            late=self._late,
            early=self._early,
            fault_ns=self._fault_ns,
        )

    def forget_past(self) -> None:
        """Reset the counters of frames that came too late or too early."""
        self._late = self._early = 0
        self._fault_ns = None

    def _check_window(self, error: float, now_ns: int) -> None:
        if not self._is_locked or abs(error) <= self._lead_ns / 2:
            return
        self._late += error > 0
        self._early += error < 0
        self._fault_ns = now_ns
