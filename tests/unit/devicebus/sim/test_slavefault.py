"""Faults inside one slave, as a master meets them."""

from __future__ import annotations

import pytest

from devicebus.sim.slavefault import SLAVE_FAULTS
from devicebus.sim.spec import FaultKind, FaultSpec
from devicebus.wire.alstatus import ERROR, AlState, AlStatusCode
from eap.codec.mailbox import MailboxType
from tests.support.bus import Bench

UPLOAD = bytes.fromhex("0a00 0000 00 03 0020 40 1810 01 00000000")
ABORTED = bytes.fromhex("0a00 0000 00 13 0020 80 1810 01 00000006")


@pytest.fixture
def bench():
    bench = Bench()
    bench.bring(AlState.PREOP)
    return bench


def switch(bench, kind, *, on=True, **more):
    spec = FaultSpec(kind=FaultKind(kind), slave="slave", **more)
    SLAVE_FAULTS[spec.kind](bench.slaves[0], spec, bench.now_ns, on)


def test_stuck_mailbox(bench):
    switch(bench, "mailbox")
    assert (bench.post(UPLOAD), bench.fetch().wkc, bench.post(UPLOAD)) == (1, 0, 0)
    switch(bench, "mailbox", on=False)
    bench.now_ns = 2_000_000
    bench.status()
    assert bench.fetch().wkc == 1


def test_aborted_object(bench):
    switch(bench, "sdo", object="0x1018", code=0x06000000)
    bench.post(UPLOAD)
    assert bench.fetch().data[:16] == ABORTED
    switch(bench, "sdo", object="0x1018", on=False)
    bench.post(UPLOAD)
    assert bench.fetch().data[8] == 0x43


def test_slow_files(bench):
    server = bench.slaves[0].device.mailbox.protocols[MailboxType.FOE]
    switch(bench, "foe", delay_us=1500)
    assert server.packet_time_ns == 1_500_000
    switch(bench, "foe", on=False)
    assert server.packet_time_ns == 0


def test_files_of_a_slave_without_mailbox_are_not_slow():
    bench = Bench()
    bench.slaves[0].device.mailbox = None
    switch(bench, "foe", delay_us=1500)
    assert bench.status() == (AlState.INIT, 0)


def test_error_of_its_own(bench):
    switch(bench, "al-error", code=0x8001)
    assert bench.status() == (AlState.PREOP | ERROR, 0x8001)
    switch(bench, "al-error", on=False)
    assert bench.status() == (AlState.PREOP | ERROR, 0x8001)


def test_emergency_and_its_end(bench):
    for on, body in ((True, "1050 01"), (False, "0000 00")):
        switch(bench, "emergency", on=on, code=0x5010)
        bench.now_ns += 2_000_000
        bench.status()
        assert bench.fetch().data[6:16] == bytes.fromhex("0010") + bytes.fromhex(body) + bytes(5)


def test_emergency_needs_coe():
    bench = Bench()
    bench.slaves[0].device.mailbox = None
    switch(bench, "emergency", code=0x5010)
    assert bench.status() == (AlState.INIT, 0)


def test_refused_state(bench):
    switch(bench, "refuse", state="INIT")
    bench.ask(AlState.INIT)
    assert bench.status() == (AlState.PREOP | ERROR, AlStatusCode.UNSPECIFIED)
    switch(bench, "refuse", state="INIT", on=False)
    bench.ask(AlState.INIT)
    assert bench.status() == (AlState.INIT, 0)


def test_drift(bench):
    clock = bench.slaves[0].esc.clock
    clock.local_time(0)
    switch(bench, "drift", drift_ppm=100.0)
    assert clock.local_time(10**9) == 10**9 + 10**5
    bench.now_ns = 10**9
    switch(bench, "drift", on=False)
    assert clock.local_time(2 * 10**9) == 2 * 10**9 + 10**5
