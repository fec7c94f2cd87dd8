"""Faults inside one slave, as a master meets them."""

from __future__ import annotations

import pytest

from devicebus.sim.slavefault import SLAVE_FAULTS
from devicebus.sim.spec import DeviceKind, FaultKind, FaultSpec, SlaveSpec
from devicebus.wire.alstatus import ERROR, AlState, AlStatusCode
from devicebus.wire.register import EepromControl
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


def test_refused_files(bench):
    server = bench.slaves[0].device.mailbox.protocols[MailboxType.FOE]
    switch(bench, "foe", code=0x8007)
    (answer,) = server.receive_message(b"\1\0\0\0\0\0firmware.bin", 0)
    assert answer[:6] == bytes.fromhex("0500 07800000")
    switch(bench, "foe", on=False)
    (answer,) = server.receive_message(b"\1\0\0\0\0\0firmware.bin", 0)
    assert answer[0] == 3


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


def test_emergency_of_an_axis_is_a_fault_of_it():
    bench = Bench(SlaveSpec(name="slave", kind=DeviceKind.DRIVE, axes=2))
    switch(bench, "emergency", code=0x7500, axis=1)
    dictionary = bench.slaves[0].device.dictionary
    assert [dictionary.entry(index, 0).value for index in (0x603F, 0x683F)] == [0, 0x7500]
    switch(bench, "emergency", code=0x7500, axis=1, on=False)
    assert dictionary.entry(0x6841, 0).value & 0x6F == 8


def test_pdo_that_nobody_asked_for(bench):
    bench.slaves[0].device.dictionary.entry(0x6000, 1).value = 0x1234
    switch(bench, "tx-pdo", object="0x1A00")
    bench.now_ns += 2_000_000
    bench.status()
    assert bench.fetch().data[6:11] == bytes.fromhex("0040 3412 00")
    for object_, on in (("0x1A07", True), ("0x1A00", False)):
        switch(bench, "tx-pdo", object=object_, on=on)
        bench.now_ns += 2_000_000
        bench.status()
        assert bench.fetch().wkc == 0


def test_slow_and_broken_eeprom(bench):
    def take_ns():
        bench.write(0x0502, bytes.fromhex("0001 08000000"))
        for wait_us in range(0, 5000, 50):
            bench.now_ns += 50_000
            status = EepromControl.decode(bench.read(0x0502, 2).data)
            if not status.busy:
                return wait_us, status.command_error
        return None

    assert take_ns() == (0, 0)
    switch(bench, "eeprom", delay_us=1000)
    assert take_ns() == (1000, 0)
    switch(bench, "eeprom")
    assert take_ns() == (0, 1)
    switch(bench, "eeprom", on=False)
    assert take_ns() == (0, 0)
