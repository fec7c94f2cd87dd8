"""Lock of the cycle to a reference clock: convergence, drift, jitter, faults."""

from __future__ import annotations

import random

import pytest

from devicebus.master.lock import CycleLock

CYCLE = 1_000_000


class Rig:
    """A host that sends one frame a cycle, and a reference clock with a drift and an offset."""

    def __init__(self, lock, *, ppm=0.0, offset_ns=0, jitter_ns=0, late=0.0, seed=1):
        self.lock = lock
        self.ppm = ppm
        self.offset_ns = offset_ns
        self.jitter_ns = jitter_ns
        self.late = late
        self.dice = random.Random(seed)
        self.due_ns = 10**12
        self.phases = []
        self.steps = []

    def reference(self, now_ns):
        return round(now_ns * (1 + self.ppm * 1e-6)) + self.offset_ns

    def run(self, cycles, *, is_silent=False):
        self.phases, self.steps = [], []
        for _ in range(cycles):
            # Wake-ups are late and never early, as a rule by little.
            late_ns = self.dice.expovariate(1 / self.jitter_ns) if self.jitter_ns else 0
            if self.dice.random() < self.late:
                late_ns += 3 * CYCLE
            now_ns = self.due_ns + round(late_ns)
            time_ns = self.reference(now_ns)
            self.phases.append(time_ns % CYCLE)
            if not is_silent:
                self.lock.note(time_ns, now_ns)
            step_ns = self.lock.take_step()
            self.steps.append(step_ns)
            self.due_ns += step_ns


@pytest.mark.parametrize("offset_ns", [0, 1, 299_999, 499_999, 700_000, 999_999])
@pytest.mark.parametrize("ppm", [-300.0, -20.0, 0.0, 100.0, 900.0])
def test_cycle_converges_to_the_set_point_at_any_phase_and_drift(ppm, offset_ns):
    lock = CycleLock(CYCLE)
    rig = Rig(lock, ppm=ppm, offset_ns=offset_ns)
    rig.run(1500)
    assert all(abs(step - CYCLE) <= CYCLE // 200 + CYCLE // 1000 for step in rig.steps)
    rig.run(100)
    # 0.3 cycles before SYNC0, which comes at multiples of the cycle.
    assert max(abs(phase - 700_000) for phase in rig.phases) < 200
    report = lock.report()
    assert report.is_locked
    assert abs(report.offset_ns) < 200
    # A reference that is fast by so much makes the host slow.
    assert report.drift_ppb == pytest.approx(-1000 * ppm, abs=1500)
    assert (report.late, report.early, report.fault_ns) == (0, 0, None)


def test_jitter_of_frames_is_damped():
    lock = CycleLock(CYCLE)
    rig = Rig(lock, ppm=50.0, offset_ns=123_456, jitter_ns=10_000)
    rig.run(2000)
    rig.run(4000)
    assert lock.report().is_locked
    assert max(abs(step - CYCLE) for step in rig.steps) < 3_000
    mean = sum(rig.phases) / len(rig.phases)
    assert mean == pytest.approx(700_000, abs=2_000)
    assert lock.report().late == 0


def test_late_frames_are_counted_and_move_the_cycle_little():
    lock = CycleLock(CYCLE)
    rig = Rig(lock, offset_ns=5, jitter_ns=5_000)
    rig.run(2000)
    before = lock.report()
    lock.note(rig.reference(rig.due_ns) + 250_000, 77)
    lock.note(rig.reference(rig.due_ns) - 250_000, 78)
    report = lock.report()
    assert (report.late - before.late, report.early - before.early) == (1, 1)
    assert report.fault_ns == 78
    assert report.is_locked
    assert abs(lock.take_step() - CYCLE) < 3_000
    lock.forget_past()
    assert (lock.report().late, lock.report().early, lock.report().fault_ns) == (0, 0, None)


def test_lock_survives_wake_ups_that_are_late_by_cycles():
    lock = CycleLock(CYCLE)
    rig = Rig(lock, ppm=-80.0, jitter_ns=20_000, late=0.02)
    rig.run(6000)
    assert lock.report().is_locked
    assert lock.report().drift_ppb == pytest.approx(80_000, abs=30_000)


def test_cycle_keeps_its_length_without_a_reference_and_locks_again():
    lock = CycleLock(CYCLE)
    rig = Rig(lock, ppm=100.0, offset_ns=321)
    rig.run(3000)
    rig.run(200, is_silent=True)
    assert lock.report().is_locked
    rig.run(1800, is_silent=True)
    assert not lock.report().is_locked
    # 100 ppm would be 200 µs by now.
    assert abs(rig.phases[-1] - 700_000) < 3_000
    rig.offset_ns += 400_000
    rig.run(2000)
    assert lock.report().is_locked
    assert abs(rig.phases[-1] - 700_000) < 200


def test_drift_that_changes_is_followed():
    lock = CycleLock(CYCLE)
    rig = Rig(lock, ppm=10.0)
    rig.run(2000)
    now_ns = rig.due_ns
    before = rig.reference(now_ns)
    rig.ppm = -40.0
    rig.offset_ns += before - rig.reference(now_ns)
    rig.run(1500)
    assert lock.report().is_locked
    assert lock.report().late == lock.report().early == 0
    assert abs(rig.phases[-1] - 700_000) < 300


@pytest.mark.parametrize(("lead_ns", "shift_ns"), [(0, 50_000), (400_000, 0), (100_000, -20_000)])
def test_set_point_is_the_lead_before_the_first_sync0(lead_ns, shift_ns):
    rig = Rig(CycleLock(CYCLE, lead_ns, shift_ns))
    rig.run(2000)
    wanted = (shift_ns - (lead_ns or 300_000)) % CYCLE
    assert abs(rig.phases[-1] - wanted) < 200
