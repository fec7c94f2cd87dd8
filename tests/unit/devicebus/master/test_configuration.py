from __future__ import annotations

import pytest

from devicebus.errors import BusError, StateTimeoutError
from devicebus.master.bus import MasterSettings
from devicebus.master.configuration import with_watchdog
from devicebus.master.master import Master
from devicebus.master.pdo import ProcessDataChannel
from devicebus.sim.spec import ChannelSpec, MailboxSpec, ObjectSpec
from devicebus.wire.alstatus import AlState
from devicebus.wire.register import Register, SyncManager
from eap.od.slave_config import (
    IdnWrite,
    MappedObject,
    OpMode,
    SdoWrite,
    StateTimeouts,
    Transition,
    Watchdogs,
)
from tests.support.busline import MS, Paced, expect, segment, slave

PARAMETER = ObjectSpec(index=0x8000, name="Parameter", type="UINT")
OTHER = ObjectSpec(index=0x8001, name="Other", type="UINT")
LIMITED = ObjectSpec(index=0x8002, name="Limited", type="UINT", maximum=10)


def box(name="a", **options):
    return slave(name, objects=(PARAMETER, OTHER, LIMITED), **options)


def write(at, value, index=0x8000):
    return SdoWrite(
        at=tuple(map(Transition, at.split())), index=index, data=value.to_bytes(2, "little")
    )


def line_of(*specs, **config):
    """A line whose first slave has this configuration."""
    expected = [expect(spec, **(config if spec is specs[0] else {})) for spec in specs]
    line = Paced(Master(MasterSettings(expected=expected)), segment(*specs))
    line.written = []
    for unit in line.segment.slaves:
        record(line, unit)
    return line


def record(line, unit):
    """Note each download to the objects from 0x8000 on, with the state it came in."""
    for index in (0x8000, 0x8001, 0x8002, 0x6060):
        if index in unit.device.dictionary:
            entry = unit.device.dictionary.entry(index, 0)
            check = entry.write

            def note(octets, index=index, check=check, unit=unit):
                if check is not None:
                    check(octets)
                line.written.append((unit.state.name, index, octets[0]))

            entry.write = note


def bring(line, target=AlState.OP):
    line.wait(line.core.bring_up(line.now_ns, target))


def go(line, target, station=1001):
    line.wait(line.core.request_state(station, target, line.now_ns))


def faults(line):
    return [each.reason for each in line.events() if hasattr(each, "reason")]


def test_start_up_writes_are_sent_in_their_transitions():
    line = line_of(
        box(),
        writes=(
            write("SO", 3), write("IP PS", 1), write("PS", 2, 0x8001), write("OS OI", 4),
            write("SP", 5), write("PI", 6),
        ),
    )  # fmt: skip
    bring(line)
    up = [("PREOP", 0x8000, 1), ("PREOP", 0x8000, 1), ("PREOP", 0x8001, 2), ("SAFEOP", 0x8000, 3)]
    assert line.written == up
    del line.written[:]
    for target in (AlState.SAFEOP, AlState.PREOP, AlState.INIT):
        go(line, target)
    assert line.written == [("OP", 0x8000, 4), ("SAFEOP", 0x8000, 5), ("PREOP", 0x8000, 6)]
    del line.written[:]
    go(line, AlState.OP)
    assert line.written == up


def test_writes_to_init_are_sent_before_the_mailbox_closes():
    line = line_of(box(), writes=(write("OI", 4), write("SI", 5)))
    bring(line)
    line.wait(line.core.shut_down(line.now_ns))
    assert line.written == [("OP", 0x8000, 4)]
    assert line.segment.slaves[0].state is AlState.INIT


@pytest.mark.parametrize("fault", ["al-error", "power"])
def test_writes_are_repeated_after_a_restart(fault):
    line = line_of(box(), writes=(write("PS", 1),))
    bring(line)
    del line.written[:]
    unit = line.segment.slaves[0]
    if fault == "power":
        line.segment.switch(0, on=False)
        line.elapse(200 * MS)
        line.segment.switch(0, on=True)
    else:
        unit.fail(0x0060)
        unit.device.al_state = AlState.INIT
        unit.esc.set_al_status(0x11, 0x0060)
    line.elapse_until(lambda: unit.state is AlState.OP)
    assert unit.state is AlState.OP
    assert line.written == [("PREOP", 0x8000, 1)]


def test_refused_write_leaves_the_slave_out_and_is_named():
    line = line_of(box(), box("b"), writes=(write("PS", 99, 0x8002),))
    with pytest.raises(BusError) as caught:
        bring(line)
    assert str(caught.value).startswith(
        "slave 1001: start-up write of 0x8002:00 in PS (data 63 00): value"
    )
    assert "0x0609003" in str(caught.value)
    assert [unit.state for unit in line.segment.slaves] == [AlState.PREOP, AlState.OP]
    line.elapse(2500 * MS)
    assert [each for each in faults(line) if "start-up write of 0x8002:00 in PS" in each]
    # It is tried again: a slave that takes the value later reaches OP.
    line.segment.slaves[0].device.dictionary.entry(0x8002, 0).maximum = None
    line.elapse_until(lambda: line.segment.slaves[0].state is AlState.OP)
    assert line.segment.slaves[0].state is AlState.OP
    assert line.core.cycle.is_full


def test_write_needs_its_protocol():
    idn = IdnWrite(idn=0x8001, data=b"\1\0")
    line = line_of(box(), writes=(idn,))
    with pytest.raises(BusError, match=r"start-up write of P-0-0001 in PS: it has no mailbox with"):
        bring(line)
    line = line_of(slave("a", mailbox=None), writes=(write("PS", 1),))
    with pytest.raises(BusError, match=r"0x8000:00 in PS: it has no mailbox with COE"):
        bring(line)


def test_idn_is_written_to_its_drive():
    spec = slave("d", "drive", axes=2, mailbox=MailboxSpec(soe=True))
    idn = IdnWrite(idn=47, data=(5).to_bytes(4, "little"), drive=1)
    line = line_of(spec, writes=(idn,))
    bring(line, AlState.SAFEOP)
    dictionary = line.segment.slaves[0].device.dictionary
    assert dictionary.entry(0x607A + 0x800, 0).value == 5
    wrong = IdnWrite(idn=0x8FFF, data=b"\0\0", drive=1)
    line = line_of(spec, writes=(wrong,))
    with pytest.raises(
        BusError, match=r"start-up write of P-0-4095 of drive 1 in PS .*no such IDN"
    ):
        bring(line)


def test_mapping_and_assignment_are_written_before_the_writes_of_ps():
    spec = slave(
        "a",
        inputs=(ChannelSpec(name="x", type="UINT"), ChannelSpec(name="y", type="UINT")),
        outputs=(ChannelSpec(name="o", type="UINT"),),
        objects=(PARAMETER,),
    )
    line = line_of(
        spec,
        assignment={2: (0x1600,), 3: (0x1A00,)},
        mapping={0x1A00: (MappedObject(0x6000, 2, 16),)},
        writes=(write("PS", 7),),
    )
    bring(line)
    assert [each.name for each in line.core.image.layout.variables] == ["o", "y"]
    assert line.written == [("PREOP", 0x8000, 7)]
    # After a restart of the slave the mapping is written again.
    line.segment.switch(0, on=False)
    line.elapse(200 * MS)
    line.segment.switch(0, on=True)
    line.elapse_until(lambda: line.segment.slaves[0].state is AlState.OP)
    assert line.segment.slaves[0].state is AlState.OP
    assert line.segment.slaves[0].device.process_data.inputs.size == 2


def test_refused_mapping_is_named():
    line = line_of(
        slave("a"), assignment={3: (0x1A00,)}, mapping={0x1A00: (MappedObject(0x6055, 1, 8),)}
    )
    with pytest.raises(
        BusError, match=r"slave 1001: PDO configuration in PS: 0x1A00:00: object cannot be"
    ):
        bring(line)
    line = line_of(slave("a"), assignment={3: (0x1A05,)})
    with pytest.raises(BusError, match=r"slave 1001: PDO configuration in PS: 0x1C13:00: "):
        bring(line)


def test_list_that_is_fixed_is_no_error_if_it_is_as_wanted():
    line = line_of(slave("a"), assignment={2: (0x1600,), 3: (0x1A00,)})
    for index in (0x1C12, 0x1C13):
        entries = line.segment.slaves[0].device.dictionary[index].entries
        for entry in entries.values():
            entry.access &= ~0x38
    bring(line)
    assert line.segment.slaves[0].state is AlState.OP


def test_assignment_of_a_slave_without_coe_is_that_of_its_sync_managers():
    spec = slave(
        "a",
        mailbox=None,
        inputs=(
            ChannelSpec(name="x", type="UINT"),
            ChannelSpec(name="y", type="UDINT", pdo=0x1A01, assigned=False),
        ),
    )
    line = line_of(spec, assignment={3: (0x1A00,)})
    bring(line)
    assert [each.name for each in line.core.image.layout.variables] == ["out", "x"]
    line = line_of(spec, assignment={1: (0x1A07,)})
    with pytest.raises(BusError, match=r"PDO 0x1A07 cannot be assigned to sync manager 1: the"):
        bring(line)


def test_watchdogs_are_written_to_the_controller():
    line = line_of(slave("a"), watchdogs=Watchdogs(process_data_ms=20, pdi_ms=0, enabled=False))
    bring(line)
    memory = line.segment.slaves[0].esc.memory
    for at, steps in ((Register.WATCHDOG_PROCESS_DATA, 200), (Register.WATCHDOG_PDI, 0)):
        assert int.from_bytes(memory[at : at + 2], "little") == steps
    assert not SyncManager.decode(memory, Register.SYNC_MANAGER + 16).watchdog


def test_watchdog_trigger_is_a_bit_of_outputs_only():
    channels = (
        ProcessDataChannel(2, 0x1100, 0x24, True, ()),
        ProcessDataChannel(3, 0x1180, 0x20, False, ()),
    )
    assert [each.control for each in with_watchdog(channels, enabled=True)] == [0x64, 0x20]
    assert [each.control for each in with_watchdog(channels, enabled=False)] == [0x24, 0x20]
    assert with_watchdog(channels, enabled=None) == channels


def test_sync0_needs_a_clock():
    line = line_of(slave("a", clock=None), slave("b"), sync=OpMode())
    with pytest.raises(BusError, match="slave 1001: SYNC0 is configured, but it has no distr"):
        bring(line)


def test_sync0_follows_the_cycle_of_the_bus():
    expected = [expect(slave("a"), sync=OpMode(factor0=2, shift0_ns=300))]
    settings = MasterSettings(expected=expected, cycle_ns=500_000)
    line = Paced(Master(settings), segment(slave("a")))
    bring(line)
    esc = line.segment.slaves[0].esc
    at = Register.DC_SYNC0_CYCLE
    assert int.from_bytes(esc.memory[at : at + 4], "little") == MS
    assert esc.clock.sync0_is_active


def test_state_timeout_of_the_slave_is_kept():
    line = line_of(slave("a"), timeouts=StateTimeouts(safeop_op_ms=300))
    line.segment.slaves[0].esc.set_al_status = lambda state, code: None
    with pytest.raises(StateTimeoutError, match="expected PREOP within 3000 ms"):
        bring(line)
    line = line_of(slave("a"), timeouts=StateTimeouts(preop_ms=300))
    line.segment.slaves[0].esc.set_al_status = lambda state, code: None
    with pytest.raises(StateTimeoutError, match="expected PREOP within 300 ms"):
        bring(line)


def test_time_limit_of_answers_is_that_of_the_slave():
    config = {"writes": (write("PS", 1),), "timeouts": StateTimeouts(response_ms=150)}
    line = line_of(box(), **config)
    line.segment.slaves[0].device.mailbox.next_message = lambda now_ns: None
    begun_ns = line.now_ns
    with pytest.raises(BusError, match=r"in PS .data 01 00.: no COE reply within 150 ms"):
        bring(line)
    assert line.now_ns - begun_ns < 2000 * MS
