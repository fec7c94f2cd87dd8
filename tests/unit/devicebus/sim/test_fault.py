"""Faults of frames and cables, by script and by command, in virtual time."""

from __future__ import annotations

import json
from contextlib import suppress

import pytest
from hypothesis import given
from hypothesis import strategies as st

from devicebus.sim import fault as commands
from devicebus.sim.devices.build import build_slave
from devicebus.sim.fault import SLAVE_FAULTS, FaultySegment, find_entry
from devicebus.sim.segment import SimulatedSegment
from devicebus.sim.spec import (
    ChannelSpec,
    DeviceKind,
    EntrySpec,
    FaultKind,
    FaultSpec,
    ObjectSpec,
    SlaveSpec,
)
from devicebus.wire.alstatus import ERROR, AlState, AlStatusCode
from devicebus.wire.datagram import Command, encode_frame, iter_datagrams
from devicebus.wire.register import EepromControl, Register
from eap.codec.mailbox import MailboxType
from tests.support.bus import Bench, datagram, generic

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


def test_mailbox_fault_takes_messages_and_gives_none(bench):
    switch(bench, "mailbox")
    assert (bench.post(UPLOAD), bench.fetch().wkc, bench.post(UPLOAD)) == (1, 0, 0)
    switch(bench, "mailbox", on=False)
    bench.now_ns = 2_000_000
    bench.status()
    assert bench.fetch().wkc == 1


def test_sdo_fault_aborts_one_object(bench):
    switch(bench, "sdo", object="0x1018", code=0x06000000)
    bench.post(UPLOAD)
    assert bench.fetch().data[:16] == ABORTED
    switch(bench, "sdo", object="0x1018", on=False)
    bench.post(UPLOAD)
    assert bench.fetch().data[8] == 0x43


def test_foe_fault_delays_packets(bench):
    server = bench.slaves[0].device.mailbox.protocols[MailboxType.FOE]
    switch(bench, "foe", delay_us=1500)
    assert server.packet_time_ns == 1_500_000
    switch(bench, "foe", on=False)
    assert server.packet_time_ns == 0


def test_foe_fault_refuses_files(bench):
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


def test_state_fault_refuses_one_state(bench):
    switch(bench, "refuse", state="INIT")
    bench.ask(AlState.INIT)
    assert bench.status() == (AlState.PREOP | ERROR, AlStatusCode.UNSPECIFIED)
    switch(bench, "refuse", state="INIT", on=False)
    bench.ask(AlState.INIT)
    assert bench.status() == (AlState.INIT, 0)


def test_drift_fault_changes_the_clock(bench):
    clock = bench.slaves[0].esc.clock
    clock.local_time(0)
    switch(bench, "drift", drift_ppm=100.0)
    assert clock.local_time(10**9) == 10**9 + 10**5
    bench.now_ns = 10**9
    switch(bench, "drift", on=False)
    assert clock.local_time(2 * 10**9) == 2 * 10**9 + 10**5


def test_emergency_fault_puts_the_axis_into_fault():
    bench = Bench(SlaveSpec(name="slave", kind=DeviceKind.DRIVE, axes=2))
    switch(bench, "emergency", code=0x7500, axis=1)
    dictionary = bench.slaves[0].device.dictionary
    assert [dictionary.entry(index, 0).value for index in (0x603F, 0x683F)] == [0, 0x7500]
    switch(bench, "emergency", code=0x7500, axis=1, on=False)
    assert dictionary.entry(0x6841, 0).value & 0x6F == 8


def test_tx_pdo_fault_sends_an_unsolicited_pdo(bench):
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


@pytest.fixture
def device():
    entries = (EntrySpec(subindex=2, name="gain", type="UINT"),
               EntrySpec(subindex=3, name="twice", type="UINT"))  # fmt: skip
    return build_slave(
        generic(
            objects=(
                ObjectSpec(index=0x8000, name="settings", entries=entries),
                ObjectSpec(index=0x8001, name="twice", type="UINT"),
            )
        )
    ).device


@pytest.mark.parametrize(
    ("text", "place"),
    [
        ("level", (0x6000, 1)),
        ("valve", (0x7000, 2)),
        ("gain", (0x8000, 2)),
        ("0x8000:3", (0x8000, 3)),
        ("8001", (0x8001, 0)),
        ("8000:03", (0x8000, 3)),
    ],
)
def test_entry_is_found(device, text, place):
    assert find_entry(device, text) == place


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("speeed", "no entry 'speeed' .inputs and outputs: level, limit, speed, valve"),
        ("twice", "several entries 'twice': 0x8000:03, 0x8001:00"),
        ("0x8000:9", "no entry 0x8000:09"),
        ("0x9000", "no entry 0x9000:00"),
        ("0xZZ", "is not INDEX.:SUB. in hexadecimal"),
        ("", "no entry ''"),
    ],
)
def test_entry_is_not_found(device, text, reason):
    with pytest.raises(ValueError, match=reason):
        find_entry(device, text)


MS = 1_000_000


def fault(kind, **more) -> FaultSpec:
    return FaultSpec(kind=FaultKind(kind), **more)


def make(*script) -> FaultySegment:
    slaves = [build_slave(generic(name)) for name in ("a", "b", "c")]
    return FaultySegment(SimulatedSegment(slaves), script)


def exchange(faulty, now_ns=0, command=Command.BRD, ado=0, size=1, adp=0):
    """Send one datagram; return (working counter, data) of each frame that is back now."""
    frame = bytearray(encode_frame([datagram(command, adp, ado, bytes(size))]))
    faulty.receive_frame(frame, now_ns, origin="me")
    return answers(faulty, now_ns)


def answers(faulty, now_ns):
    found = []
    for out in faulty.frames_to_send(now_ns):
        assert out.origin == "me"
        found += [(wkc, bytes(data)) for _, data, wkc in iter_datagrams(out.frame)]
    return found


def wkcs(faulty, now_ns=0):
    return [wkc for wkc, _ in exchange(faulty, now_ns)]


def test_without_faults_every_frame_is_back_at_once():
    faulty = make()
    assert wkcs(faulty) == [3]
    assert faulty.next_timeout() is None


def test_every_third_frame_is_lost():
    faulty = make(fault("loss", every=3))
    assert [wkcs(faulty) for _ in range(6)] == [[3], [3], [], [3], [3], []]


def test_frames_are_late_and_keep_their_order():
    faulty = make(fault("delay", delay_us=500, for_ms=1))
    assert wkcs(faulty) == []
    assert exchange(faulty, MS - 1, ado=4) == [(3, b"\x11")]
    assert faulty.next_timeout() == MS
    assert wkcs(faulty, MS) == [3]
    assert answers(faulty, MS + 499_999) == [(3, b"\x08")]


def test_wrong_working_counter():
    faulty = make(fault("wkc", every=2))
    assert [wkcs(faulty) for _ in range(4)] == [[3], [2], [3], [2]]


def test_wrong_working_counter_in_each_datagram():
    faulty = make(fault("wkc"))
    datagrams = [datagram(Command.BRD, 0, 0, b"\0"), datagram(Command.NOP, 0, 0, b"")]
    faulty.receive_frame(bytearray(encode_frame(datagrams)), 0, origin="me")
    assert answers(faulty, 0) == [(2, b"\x11"), (0, b"")]


def test_damage_fault_is_counted_at_its_cable():
    faulty = make(fault("corrupt", slave="b", for_ms=1))
    assert wkcs(faulty) == []
    assert wkcs(faulty) == []
    counters = [
        exchange(faulty, MS, Command.APRD, at, 1, -n & 0xFFFF)[0][1][0]
        for n in range(3)
        for at in (Register.RX_ERROR, Register.FORWARDED_RX_ERROR)
    ]
    assert counters == [0, 0, 2, 0, 0, 2]


def test_damaged_frame_is_taken_in_front_of_the_damage_only():
    faulty = make(fault("corrupt", slave="b", for_ms=1))
    assert exchange(faulty, 0, Command.BWR, Register.STATION_ADDRESS, 2) == []
    frame = bytearray(encode_frame([datagram(Command.BWR, 0, 0x1F00, b"\x55")]))
    faulty.receive_frame(frame, 0)
    memory = [slave.esc.peek(0x1F00, 1) for slave in faulty.segment.slaves]
    assert memory == [b"\x55", b"\0", b"\0"]


def test_damage_fault_without_frames_has_no_effect():
    faulty = make(fault("corrupt", slave="c", for_ms=1), fault("cut", slave="b", for_ms=1))
    faulty.handle_timeout(0)
    assert wkcs(faulty) == []
    assert faulty.segment.slaves[2].esc.peek(Register.RX_ERROR, 1) == b"\0"


def test_cut_by_script_is_mended_in_time():
    faulty = make(fault("cut", slave="b", at_ms=10, for_ms=5))
    assert wkcs(faulty, 7) == [3]
    assert faulty.next_timeout() == 10 * MS + 7
    assert wkcs(faulty, 10 * MS + 7) == [1]
    assert wkcs(faulty, 15 * MS + 6) == [1]
    assert wkcs(faulty, 15 * MS + 7) == [3]
    lost = exchange(faulty, 16 * MS, Command.APRD, Register.LOST_LINK, 4)
    assert lost == [(1, b"\0\1\0\0")]


def test_power_by_command():
    faulty = make()
    spec = fault("power", slave="c")
    faulty.begin(spec, 0)
    assert wkcs(faulty) == [2]
    faulty.end(spec, 0)
    assert wkcs(faulty) == [3]


def test_command_with_a_time_counts_from_now():
    faulty = make()
    faulty.handle_timeout(0)
    faulty.begin(fault("cut", slave="a", at_ms=1, for_ms=1), 5 * MS)
    assert [wkcs(faulty, at * MS) for at in (5, 6, 7)] == [[3], [], [3]]


def test_fault_inside_a_slave():
    faulty = make(fault("refuse", slave="a", state="PREOP", code=0x8000))
    faulty.handle_timeout(0)
    assert faulty.segment.slaves[0].refused_states == {AlState.PREOP: 0x8000}


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        (fault("cut", slave="x"), r"no slave 'x' \(one of a, b, c\)"),
        (fault("corrupt"), "fault corrupt: it needs a slave"),
        (fault("sdo", slave="a", object="x"), "not INDEX"),
        (fault("refuse", slave="a", state="RUN"), "no state 'RUN'"),
    ],
)
def test_fault_that_cannot_be(spec, message):
    with pytest.raises(ValueError, match=message):
        make(spec)
    with pytest.raises(ValueError, match=message):
        make().begin(spec, 0)


SET = b'{"set": {"slave": "slave", "entry": "limit", "value": true}}'
RELEASE = b'{"release": {"slave": "slave", "entry": "limit"}}'


def obey(faulty, octets, now_ns):
    commands.execute_command(faulty, json.loads(octets), now_ns)


@pytest.fixture
def commanded():
    inputs = (ChannelSpec(name="limit", values=(0,)), ChannelSpec(name="echo", follows="valve"))
    return Bench(generic(inputs=inputs, outputs=(ChannelSpec(name="valve"),)))


def inputs(commanded):
    return commanded.cycle().data[1]


def test_command_set_holds_an_input_until_release(commanded):
    faulty = FaultySegment(commanded.segment)
    commanded.bring(AlState.OP)
    assert inputs(commanded) == 0
    obey(faulty, SET, commanded.now_ns)
    assert [inputs(commanded) for _ in range(3)] == [1, 1, 1]
    obey(faulty, RELEASE, commanded.now_ns)
    assert inputs(commanded) == 0


def test_command_set_applies_to_a_slave_below_safeop(commanded):
    faulty = FaultySegment(commanded.segment)
    obey(faulty, SET, 0)
    commanded.bring(AlState.OP)
    assert inputs(commanded) == 1


def test_output_is_set_for_the_device_too(commanded):
    faulty = FaultySegment(commanded.segment)
    commanded.bring(AlState.OP)
    obey(faulty, SET.replace(b"limit", b"valve"), 0)
    assert inputs(commanded) == 2
    assert inputs(commanded) == 2


def test_numbers_of_a_fault_may_be_hexadecimal_texts():
    faulty = make()
    obey(faulty, b'{"kind":"refuse","slave":"a","state":"PREOP","code":"0x8000"}', 0)
    assert faulty.segment.slaves[0].refused_states == {AlState.PREOP: 0x8000}
    obey(faulty, b'{"kind":"refuse","slave":"a","state":"PREOP","code":"32768","end":true}', 0)
    assert faulty.segment.slaves[0].refused_states == {}
    with pytest.raises(ValueError, match=r"Expected `int`, got `str` - at `\$.code`"):
        obey(faulty, b'{"kind":"refuse","slave":"a","state":"PREOP","code":"many"}', 0)


def test_faults_begin_and_end(commanded):
    faulty = FaultySegment(commanded.segment)
    obey(faulty, b'{"kind": "power", "slave": "slave"}', 0)
    assert not commanded.slaves[0].is_powered
    obey(faulty, b'{"kind": "power", "slave": "slave", "end": true}', 0)
    assert commanded.slaves[0].is_powered


@pytest.mark.parametrize(
    ("command", "reason"),
    [
        (b"[]", "a JSON object"),
        (b"3", "a JSON object"),
        (b"{}", "kind"),
        (b'{"kind": "loss", "evry": 2}', "no key 'evry' .one of kind, .*every.*, end"),
        (b'{"kind": "power", "slave": "x"}', "no slave 'x'"),
        (SET.replace(b'"slave": "slave"', b'"slave": "x"'), "no slave 'x' .one of slave"),
        (SET.replace(b"limit", b"limt"), "no entry 'limt'"),
        (SET.replace(b"true", b'"on"'), "is not a value of BOOL"),
        (SET.replace(b"true", b"null"), "value"),
        (RELEASE, "limit was not set"),
        (b'{"set": {}}', "slave"),
        (b'{"tx": 1, "kind": "tx-pdo"}', "tx"),
        (b'{"kind": "tx-pdo", "slave": "slave", "object": "0x1600"}', "is no TxPDO"),
    ],
)
def test_unknown_fault_is_refused(commanded, command, reason):
    with pytest.raises(ValueError, match=reason):
        obey(FaultySegment(commanded.segment), command, 0)


VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3),
    max_leaves=3,
)


@given(
    st.sampled_from(("limit", "valve", "0x1008", "0x1018:1", "0x1A00:0", "0x7000:0")),
    VALUES,
    st.sampled_from(FaultKind),
)
def test_execute_command_raises_value_errors_only(entry, value, kind):
    commanded = Bench(generic())
    faulty = FaultySegment(commanded.segment)
    commands = (
        {"set": {"slave": "slave", "entry": entry, "value": value}},
        {"release": {"slave": "slave", "entry": value}},
        {"kind": kind.value, "slave": "slave", "object": entry, "code": value},
        value,
    )
    for command in commands:
        with suppress(ValueError):
            obey(faulty, json.dumps(command).encode(), 0)
    faulty.receive_frame(bytearray(encode_frame([datagram(Command.BRD, 0, 0, b"\0")])), 10**9)
