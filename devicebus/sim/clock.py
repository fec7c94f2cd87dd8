"""Distributed clock of one slave: local time, system time, control loop, SYNC0 and SYNC1.

ETG.1000.4, distributed clocks.  All times are nanoseconds; the caller passes the time.  Latch
inputs, which are optional in a controller, are missing.
"""

from __future__ import annotations

from devicebus.wire.register import Register

_PPB = 1_000_000_000
_U32 = 1 << 32
_U64 = 1 << 64
_PHASE_SHIFT = 3
_RATE_SHIFT = 8
# Larger differences come from offsets, not from the drift of the quartz.
_LOCKED_NS = 100_000
# Maximum frequency correction of the loop: the limit of an ESC is near 0.1 %.
_MAX_PPB = 1_000_000
_SYNC_OUT, _SYNC0, _SYNC1 = 0x01, 0x02, 0x04
_SYNC0_PENDING, _SYNC1_PENDING, _START_IS_PAST = 0x01, 0x02, 0x04


class Clock:
    """Clock whose local time runs *drift_ppm* fast, with its DC registers.

    Args:
        memory: Memory of the ESC.
        drift_ppm: Deviation of the slave's quartz.
        local_start_ns: Local time at power-on.
    """

    __slots__ = ("_base_local", "_base_now", "_drift_ppb", "_last_write_ns", "_memory", "_rate_ppb",
                 "_start_ns", "_sync0_seen", "_sync1_seen")  # fmt: skip

    def __init__(
        self, memory: bytearray, *, drift_ppm: float = 0.0, local_start_ns: int = 0
    ) -> None:
        self._memory = memory
        self._base_now: int | None = None
        self._base_local = local_start_ns
        self._drift_ppb = round(drift_ppm * 1000)
        self._rate_ppb = 0
        self._last_write_ns: int | None = None
        self._start_ns: int | None = None
        self._sync0_seen = self._sync1_seen = 0
        self._set(Register.DC_SPEED_START, 0x1000, 2)
        memory[Register.DC_SYSTEM_TIME_FILTER] = 4
        memory[Register.DC_SPEED_FILTER] = 12

    def set_drift(self, drift_ppm: float, now_ns: int) -> None:
        """Change the deviation of the quartz at *now_ns*."""
        self._rebase(now_ns, 0)
        self._drift_ppb = round(drift_ppm * 1000)

    def local_time(self, now_ns: int) -> int:
        """Return the local time of the slave."""
        if self._base_now is None:
            self._base_now = now_ns
        elapsed = now_ns - self._base_now
        return (
            self._base_local + elapsed + elapsed * (self._drift_ppb + self._rate_ppb) // _PPB
        ) % _U64

    def system_time(self, now_ns: int) -> int:
        """Return the slave's copy of the system time."""
        return (self.local_time(now_ns) + self._get(Register.DC_SYSTEM_TIME_OFFSET, 8)) % _U64

    def refresh(self, now_ns: int) -> None:
        """Update the time registers before a master reads them.

        The register holds the system time at which the frame passed the reference clock, so that
        all synchronized slaves answer the same.
        """
        time_ns = self.system_time(now_ns)
        delay = self._get(Register.DC_SYSTEM_TIME_DELAY, 4)
        # Without the delay a master would see a different time at every position.
        self._set(Register.DC_SYSTEM_TIME, (time_ns - delay) % _U64, 8)
        if self._start_ns is None:
            return
        first, period = self._sync1_times(self._start_ns)
        cycle = self._get(Register.DC_SYNC0_CYCLE, 4)
        sync0 = _next(self._start_ns, cycle, time_ns)
        sync1 = _next(first, period, time_ns) if self.sync1_is_active else 0
        self._set(Register.DC_START_TIME, sync0, 8)
        self._set(Register.DC_NEXT_SYNC1, sync1, 8)
        pending = _SYNC0_PENDING * (time_ns < self._start_ns)
        pending |= _SYNC1_PENDING * (self.sync1_is_active and time_ns < first)
        self._memory[Register.DC_ACTIVATION_STATUS] = pending

    def latch(
        self, now_ns: int, port_delays: tuple[int | None, ...], processing_delay: int
    ) -> None:
        """Latch the receive times of a frame; a delay of None is a port that it did not pass."""
        for port, delay in enumerate(port_delays):
            if delay is not None:
                at = Register.DC_RECEIVE_TIME + 4 * port
                self._set(at, self.local_time(now_ns + delay) % _U32, 4)
        self._set(Register.DC_RECEIVE_TIME_ECAT, self.local_time(now_ns + processing_delay), 8)

    def steer(self, data: bytes, now_ns: int) -> None:
        """Compare the system time with a distributed reference time, and correct the clock."""
        size = 8 if len(data) >= 8 else 4
        modulus = 1 << 8 * size
        received = int.from_bytes(data[:size], "little")
        received += self._get(Register.DC_SYSTEM_TIME_DELAY, 4)
        error = (self.system_time(now_ns) - received) % modulus
        # The difference is signed modulo the width of the written time.
        if error >= modulus // 2:
            error -= modulus
        # 0x092C holds sign and magnitude.
        behind = 1 << 31 if error < 0 else 0
        magnitude = min(abs(error), (1 << 31) - 1)
        self._set(Register.DC_SYSTEM_TIME_DIFFERENCE, magnitude | behind, 4)
        if self._last_write_ns is not None and now_ns > self._last_write_ns:
            interval = now_ns - self._last_write_ns
            self._rebase(now_ns, -error // (1 << _PHASE_SHIFT))
            # The rate is learnt from small errors only: a large one is an offset that was not set.
            if abs(error) < _LOCKED_NS:
                rate = self._rate_ppb - (error * _PPB // interval >> _RATE_SHIFT)
                self._rate_ppb = max(-_MAX_PPB, min(_MAX_PPB, rate))
        self._last_write_ns = now_ns

    def restart_loop(self) -> None:
        """Reset the control loop, as a write to its parameters does."""
        self._last_write_ns = None

    def activate(self, now_ns: int) -> None:
        """Start or stop SYNC0 and SYNC1 by the activation register."""
        self._sync0_seen = self._sync1_seen = 0
        self._start_ns = None
        self._memory[Register.DC_ACTIVATION_STATUS] = 0
        if not self._has(_SYNC_OUT | _SYNC0) or not self._get(Register.DC_SYNC0_CYCLE, 4):
            return
        start = self._get(Register.DC_START_TIME, 8)
        # A start time in the past starts nothing, as in a controller.
        if start < self.system_time(now_ns):
            self._memory[Register.DC_ACTIVATION_STATUS] = _START_IS_PAST
        else:
            self._start_ns = start

    @property
    def sync0_is_active(self) -> bool:
        """True if SYNC0 is active with a cycle time and a start time that was accepted."""
        return self._start_ns is not None

    @property
    def sync1_is_active(self) -> bool:
        """True if SYNC1 is active as well."""
        return self._start_ns is not None and self._has(_SYNC1)

    def take_sync0(self, now_ns: int) -> int:
        """Return the number of SYNC0 pulses since the last call."""
        if self._start_ns is None:
            return 0
        cycle = self._get(Register.DC_SYNC0_CYCLE, 4)
        pulses = _pulses(self._start_ns, cycle, self.system_time(now_ns))
        fresh, self._sync0_seen = pulses - self._sync0_seen, max(pulses, self._sync0_seen)
        return max(0, fresh)

    def take_sync1(self, now_ns: int) -> int:
        """Return the number of SYNC1 pulses since the last call."""
        if self._start_ns is None or not self.sync1_is_active:
            return 0
        pulses = _pulses(*self._sync1_times(self._start_ns), self.system_time(now_ns))
        fresh, self._sync1_seen = pulses - self._sync1_seen, max(pulses, self._sync1_seen)
        return max(0, fresh)

    def _sync1_times(self, start_ns: int) -> tuple[int, int]:
        """Return the time of the first SYNC1 pulse, and the period of SYNC1.

        SYNC1 follows a SYNC0 pulse by the SYNC1 cycle time; SYNC0 pulses meanwhile start no other.
        """
        sync0 = self._get(Register.DC_SYNC0_CYCLE, 4)
        sync1 = self._get(Register.DC_SYNC1_CYCLE, 4)
        # With a SYNC1 cycle time below that of SYNC0, each SYNC0 pulse has its SYNC1.
        return start_ns + sync1, (sync1 // sync0 + 1) * sync0 if sync0 else 0

    def _has(self, bits: int) -> bool:
        return self._memory[Register.DC_ACTIVATION] & bits == bits

    def _rebase(self, now_ns: int, step_ns: int) -> None:
        # The past keeps its rate: a new rate counts from now on only.
        local = self.local_time(now_ns)
        self._base_now = now_ns
        self._base_local = local + step_ns

    def _get(self, at: int, size: int) -> int:
        return int.from_bytes(self._memory[at : at + size], "little")

    def _set(self, at: int, value: int, size: int) -> None:
        self._memory[at : at + size] = value.to_bytes(size, "little")


def _pulses(first_ns: int, period_ns: int, time_ns: int) -> int:
    if time_ns < first_ns or not period_ns:
        return 0
    return (time_ns - first_ns) // period_ns + 1


def _next(first_ns: int, period_ns: int, time_ns: int) -> int:
    return (first_ns + _pulses(first_ns, period_ns, time_ns) * period_ns) % _U64
