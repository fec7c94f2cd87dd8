"""Registers and memory of one controller, as datagrams touch them."""

from __future__ import annotations

import pytest

from devicebus.sim.eeprom import READ_NS, WRITE_NS
from devicebus.sim.esc import REGISTERS, Esc, EscSettings, access_map
from devicebus.wire import sii
from devicebus.wire.register import AlEvent, Fmmu, Register, SyncManager
from devicebus.wire.sii import Sii, SiiFixed

SMALL = access_map(3, 4, has_dc=False)
LARGE = access_map(8, 16, has_dc=True)


@pytest.mark.parametrize(
    ("address", "readable", "writable"),
    [
        (0x0000, 1, 0), (0x0010, 1, 1), (0x0012, 1, 0), (0x0101, 1, 1), (0x0110, 1, 0),
        (0x0120, 1, 1), (0x0130, 1, 0), (0x0136, 0, 0), (0x0300, 1, 1), (0x0501, 1, 0),
        (0x0600, 1, 1), (0x062C, 1, 1), (0x062D, 1, 0), (0x0630, 0, 0), (0x081D, 1, 0),
        (0x081E, 1, 1), (0x081F, 1, 0), (0x0820, 0, 0), (0x0910, 0, 0), (0x0FFF, 0, 0),
    ],
)  # fmt: skip
def test_small_controller_has_no_such_register(address, readable, writable):
    assert (SMALL.readable[address], SMALL.writable[address]) == (readable, writable)


@pytest.mark.parametrize(
    ("address", "readable", "writable"),
    [(0x0670, 1, 1), (0x0680, 0, 0), (0x0878, 1, 1), (0x0910, 1, 1), (0x092C, 1, 0), (0x0981, 1, 1),
     (0x0982, 1, 0), (0x09A0, 1, 1)],
)  # fmt: skip
def test_large_controller_with_clock(address, readable, writable):
    assert (LARGE.readable[address], LARGE.writable[address]) == (readable, writable)


@pytest.mark.parametrize("small_or_large", [SMALL, LARGE])
def test_access_map_writable_registers_are_readable(small_or_large):
    assert len(small_or_large.readable) == len(small_or_large.writable) == REGISTERS
    assert all(r >= w for r, w in zip(*small_or_large, strict=True))


IMAGE = sii.encode(Sii(fixed=SiiFixed(pdi_control=0x0805, alias=0x1234, vendor=3)))


@pytest.fixture
def esc():
    return Esc(IMAGE, EscSettings(fmmus=3, sync_managers=4))


def test_esc_describes_itself_in_registers(esc):
    assert esc.read(0, 10, 0) == bytes.fromhex("1100 0200 03 04 08 0f 0c00")
    assert esc.read(0x0012, 2, 0) == b"\x34\x12"
    assert esc.read(0x0140, 2, 0) == b"\x05\x08"
    assert not esc.emulates_device


def test_esc_one_accessible_byte_counts(esc):
    assert esc.read(0x0132, 2, 0) == bytes(2)
    assert esc.read(0x0136, 4, 0) is None
    assert esc.write(0x0610, bytes(64), 0)
    assert not esc.write(0x0630, bytes(16), 0)
    assert not esc.write(0x0130, b"\x08\x00", 0)
    assert esc.write(0x012E, bytes(2), 0) is False


def test_octets_of_the_slave_survive_a_write_over_them(esc):
    esc.memory[0x0805] = 0x08
    assert esc.write(0x0800, b"\x00\x10\x20\x00\x26\xff\x00\xff", 0)
    assert esc.read(0x0805, 1, 0) != b"\xff"
    assert esc.read(0x0807, 1, 0) == b"\x00"


def test_station_and_alias(esc):
    assert (esc.station, esc.alias) == (0, None)
    esc.write(0x0010, b"\xe9\x03", 0)
    esc.write(0x0103, b"\x01", 0)
    assert (esc.station, esc.alias) == (0x3E9, 0x1234)


def test_al_control_is_an_event(esc):
    esc.write(Register.AL_CONTROL, b"\x02\x00", 0)
    assert esc.al_event == AlEvent.AL_CONTROL
    assert esc.read(Register.AL_EVENT, 4, 0) == b"\x01\0\0\0"


def test_events_for_the_master(esc):
    esc.write(Register.ECAT_EVENT_MASK, b"\xff\xff", 0)
    assert esc.irq == 0
    esc.set_al_status(2, 0)
    assert esc.irq == 0x0008
    assert esc.read(Register.ECAT_EVENT, 2, 0) == b"\x08\x00"
    esc.read(Register.AL_STATUS, 6, 0)
    assert esc.irq == 0
    esc.set_dl_status(0x5617)
    assert esc.irq == 0x0004
    assert esc.read(0x0110, 2, 0) == b"\x17\x56"
    assert esc.irq == 0
    esc.set_dl_status(0x5617)
    esc.set_al_status(2, 0)
    assert esc.irq == 0


def test_full_mailbox_is_an_event_for_the_master(esc):
    esc.write(Register.ECAT_EVENT_MASK, b"\x20\x00", 0)
    esc.write(0x0808, SyncManager(0x1080, 32, 2, 0, enable=1).encode(), 0)
    esc.channels[1].put(b"answer")
    assert esc.irq == 0x20
    assert esc.read(0x1080, 32, 0)[:6] == b"answer"
    assert (esc.irq, esc.al_event & 0x200) == (0, 0x200)


@pytest.mark.parametrize("group", [0x0300, 0x030C, 0x030D, 0x0310, 0x0442])
def test_esc_any_write_clears_error_counters(esc, group):
    esc.memory[group] = 7
    esc.memory[0x0309] = 7
    assert esc.write(group, b"\x55", 0)
    assert esc.read(group, 1, 0) == b"\0"
    assert esc.memory[0x0309] == (0 if group == 0x0300 else 7)


def test_esc_eeprom_command_by_one_write(esc):
    assert esc.write(0x0502, bytes.fromhex("000108000000"), 0)
    assert esc.read(0x0502, 2, READ_NS - 1) == b"\xc0\x81"
    assert not esc.write(0x0502, bytes.fromhex("000100000000"), READ_NS - 1)
    assert esc.read(0x0502, 2, READ_NS) == b"\xc0\x00"
    assert esc.read(0x0508, 4, READ_NS) == b"\3\0\0\0"


def test_eeprom_of_the_slave_is_out_of_reach(esc):
    assert esc.write(0x0500, b"\x01", 0)
    assert not esc.write(0x0502, bytes.fromhex("000108000000"), 0)
    assert esc.write(0x0500, b"\x02", 0)
    assert esc.write(0x0502, bytes.fromhex("000108000000"), 0)


def test_eeprom_outlives_the_power(esc):
    esc.write(0x0508, b"\x99\x00", 0)
    esc.write(0x0502, bytes.fromhex("010208000000"), 0)
    assert esc.read(0x0502, 2, WRITE_NS) == b"\xc0\x00"
    esc.write(0x0508, b"\x77\x00", WRITE_NS)
    esc.write(0x0502, bytes.fromhex("010208000000"), WRITE_NS)  # the power goes before it is done
    esc.write(0x0010, b"\x05\x00", WRITE_NS)
    esc.power_on()
    assert esc.station == 0
    assert esc.image[16:18] == b"\x99\x00"


def test_esc_fmmu_write_takes_effect(esc):
    unit = Fmmu(0x10000, 4, physical_start=0x1100, type=1, activate=1)
    esc.write(0x0610, unit.encode(), 0)
    ((first, last, physical, *_),) = esc.windows
    assert (first, last, physical) == (0x10000, 0x10003, 0x1100)
    esc.write(0x0600, bytes(48), 0)
    assert esc.windows == ()


def test_memory_without_a_guard_is_plain(esc):
    assert esc.write(0x1F00, b"abc", 0)
    assert esc.read(0x1F00, 3, 0) == b"abc"
    assert esc.read(0x2FFE, 4, 0) == bytes(4)
    assert esc.write(0x2FFE, b"abcd", 0)
    assert esc.read(0x2FFE, 2, 0) == b"ab"
    assert esc.read(0x3000, 2, 0) is None
    assert not esc.write(0x3000, b"x", 0)
    assert len(esc.memory) == 0x3000


def test_access_over_the_edge_of_the_registers(esc):
    assert esc.write(0x0FFE, b"abcd", 0)
    assert esc.read(0x0FFE, 4, 0) == b"\0\0cd"


def test_esc_access_across_sync_managers_is_partial(esc):
    esc.write(0x0800, SyncManager(0x1000, 32, 2, 1, enable=1).encode(), 0)
    esc.write(0x0808, SyncManager(0x1020, 32, 2, 0, enable=1).encode(), 0)
    assert esc.write(0x1000, b"m" * 48, 0)
    assert esc.channels[0].take() == b"m" * 32
    assert esc.read(0x1000, 64, 0) is None
    esc.channels[1].put(b"s" * 32)
    assert esc.read(0x1000, 64, 0) == bytes(32) + b"s" * 32
    assert esc.read(0x1010, 16, 0) is None


def test_watched_outputs_feed_the_watchdog(esc):
    esc.write(0x0810, SyncManager(0x1100, 2, 0, 1, watchdog=1, enable=1).encode(), 0)
    esc.write(0x1100, b"a", 50)
    assert esc.watchdog.deadline_ns is None
    esc.write(0x1101, b"b", 60)
    assert esc.watchdog.deadline_ns == 100_000_060


def test_repeat_bit_is_an_event(esc):
    esc.write(0x0808, SyncManager(0x1080, 32, 2, 0, enable=1).encode(), 0)
    esc.al_event = 0
    esc.write(0x080E, b"\x03", 0)
    assert esc.al_event == AlEvent.SM_ACTIVATION


def test_loop_control_is_noted_for_the_wiring(esc):
    assert not esc.loops_changed
    esc.write(0x0101, b"\x0c", 0)
    assert esc.loops_changed
    assert [esc.loop_control(port) for port in range(4)] == [0, 3, 0, 0]


def test_esc_latches_port_times(esc):
    esc.port_delays, esc.processing_delay = (100, 900, None, None), 100
    esc.read(0x0910, 8, 0)
    esc.write(0x0900, bytes(4), 1000)
    assert esc.read(0x0900, 8, 0) == (1000).to_bytes(4, "little") + (1800).to_bytes(4, "little")
    assert esc.read(0x0910, 8, 5000) == (5000).to_bytes(8, "little")
    assert esc.write(0x0910, (4000).to_bytes(8, "little"), 5000)
    assert esc.read(0x092C, 4, 5000) == (1000).to_bytes(4, "little")
    assert not esc.write(0x092C, bytes(4), 0)


def test_controller_without_clock():
    esc = Esc(IMAGE, EscSettings(has_dc=False))
    assert esc.read(0x0910, 8, 0) is None
    assert esc.read(0x0008, 2, 0) == bytes(2)


def test_sixteen_sync_managers():
    esc = Esc(IMAGE)
    assert esc.read(0x0005, 1, 0) == b"\x10"
    assert esc.write(0x0878, SyncManager(0x1800, 4, 2, 1, enable=1).encode(), 0)
    assert esc.write(0x1800, b"abcd", 0)
    assert not esc.write(0x1800, b"abcd", 0)
    assert esc.al_event & 1 << 23
    assert esc.read(0x087D, 1, 0) == b"\x09"
    assert esc.channels[15].take() == b"abcd"
    assert esc.read(0x0880, 1, 0) is None


def test_esc_overlapping_sync_managers_apply_in_order():
    esc = Esc(IMAGE)
    for number, direction in enumerate((0, 1)):
        esc.write(0x0800 + 8 * number, SyncManager(0x1800, 4, 0, direction, enable=1).encode(), 0)
    assert not esc.write(0x1800, b"abcd", 0)
    esc.write(0x0806, b"\0", 0)
    assert esc.write(0x1800, b"abcd", 0)
