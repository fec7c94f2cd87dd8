"""SOEM, by way of pysoem, as the master of our simulated slaves."""

from __future__ import annotations

from pathlib import Path
from time import monotonic

import pytest

from tests.support.appliance import wait_until
from tests.support.simulator import FAR, FAR_2, NEAR, NEAR_2, simulator, veth_pair
from tests.support.terminals import sizes_of, write_bus

pysoem = pytest.importorskip("pysoem", reason="needs pysoem: pip install pysoem")

pytestmark = [pytest.mark.net, pytest.mark.root]

BUS = """
bus: interop
slaves:
  - name: island
    kind: generic
    vendor: 0x1234
    product: 0x5678
    revision: 0x90001
    serial: 42
    mailbox: {size: 256, foe: true}
    inputs:
      - {name: level, type: UINT, follows: speed}
      - {name: echo, follows: valve}
    outputs:
      - {name: speed, type: UINT}
      - {name: valve}
    objects:
      - index: 0x8000
        name: Settings
        entries:
          - {subindex: 1, name: Gain, type: UDINT, value: 7}
          - {subindex: 2, name: Limit, type: UINT, value: 20, maximum: 100}
      - {index: 0x8001, name: Curve, type: BLOCK(2048)}
    files:
      - {name: firmware.bin, boot_only: true}
  - {name: drive, kind: drive, product: 9, clock: {drift_ppm: 50}}
  - {name: plain, kind: digital, product: 8, mailbox: null,
     inputs: [{name: a}, {name: b}], outputs: [{name: c}]}
"""
CONFIG_BUSES = Path(__file__).parents[2] / "config" / "buses"
CYCLES = 1000
TIMEOUT_US = 2_500_000
FRAME_US = 1_000_000
OP_WITHIN_S = 10.0


@pytest.fixture(scope="module")
def bus(tmp_path_factory):
    path = tmp_path_factory.mktemp("bus") / "bus.yaml"
    path.write_text(BUS)
    with veth_pair(), simulator(path) as running:
        assert running.ready == {"ready": True, "slaves": 3}
        yield running


@pytest.fixture
def master(bus):
    found = pysoem.Master()
    found.sdo_read_timeout = found.sdo_write_timeout = TIMEOUT_US
    found.open(NEAR)
    try:
        assert found.config_init() == 3
        yield found
        found.state = pysoem.INIT_STATE
        found.write_state()
    finally:
        found.close()


def lead(master, state):
    master.state = state
    master.write_state()
    assert master.state_check(state, 4 * TIMEOUT_US) == state


def operate(master):
    """Configure, and go to OP with process data running."""
    master.config_map()
    go_to_op(master)


def go_to_op(master):
    """Go to OP once configured; SOEM would wait two seconds a slave if it configured again."""
    assert master.state_check(pysoem.SAFEOP_STATE, 4 * TIMEOUT_US) == pysoem.SAFEOP_STATE
    exchange(master)
    master.state = pysoem.OP_STATE
    master.write_state()
    end_s = monotonic() + OP_WITHIN_S
    while monotonic() < end_s:
        exchange(master)
        if master.state_check(pysoem.OP_STATE, 2000) == pysoem.OP_STATE:
            return
    master.read_state()
    pytest.fail(str([(each.name, each.state, hex(each.al_status)) for each in master.slaves]))


def exchange(master) -> int:
    master.send_processdata()
    return master.receive_processdata(FRAME_US)


def test_scan_finds_names_and_identities(master):
    island, drive, plain = master.slaves
    assert (island.name, drive.name, plain.name) == ("island", "drive", "plain")
    assert (island.man, island.id, island.rev) == (0x1234, 0x5678, 0x90001)
    assert master.state_check(pysoem.PREOP_STATE, TIMEOUT_US) == pysoem.PREOP_STATE


def test_sdo_read_and_write(master):
    island = master.slaves[0]
    assert island.sdo_read(0x1018, 4) == (42).to_bytes(4, "little")
    assert island.sdo_read(0x1008, 0) == b"island"
    island.sdo_write(0x8000, 1, bytes.fromhex("01020304"))
    assert island.sdo_read(0x8000, 1) == bytes.fromhex("01020304")


@pytest.mark.parametrize(
    ("index", "subindex", "data", "code"),
    [
        (0x9999, 0, None, 0x06020000),
        (0x8000, 9, None, 0x06090011),
        (0x8000, 2, b"\xff\x00", 0x06090031),
        (0x8000, 1, b"\x01", 0x06070013),
        (0x1018, 1, b"\x01\0\0\0", 0x06010002),
    ],
)
def test_pysoem_gets_abort_codes(master, index, subindex, data, code):
    island = master.slaves[0]
    access = island.sdo_read if data is None else island.sdo_write
    arguments = (index, subindex) if data is None else (index, subindex, data)
    with pytest.raises(pysoem.SdoError) as caught:
        access(*arguments)
    assert caught.value.abort_code == code


def test_abort_by_a_fault(bus, master):
    island = master.slaves[0]
    spec = {"kind": "sdo", "slave": "island", "object": "0x8000", "code": 0x06060000}
    assert bus.fault(**spec) == {"ok": True}
    with pytest.raises(pysoem.SdoError) as caught:
        island.sdo_read(0x8000, 1)
    assert caught.value.abort_code == 0x06060000
    assert bus.fault(**spec, end=True) == {"ok": True}
    island.sdo_read(0x8000, 1)


def test_pysoem_lists_objects(master):
    island = master.slaves[0]
    found = {item.index: item for item in island.od}
    assert {0x1000, 0x1018, 0x1A00, 0x1C12, 0x6000, 0x7000, 0x8000, 0x8001} <= set(found)
    assert found[0x8000].name == b"Settings"
    names = [entry.name for entry in found[0x8000].entries]
    assert names == [b"SubIndex 000", b"Gain", b"Limit"]


def test_pysoem_writes_and_reads_segments(master):
    island = master.slaves[0]
    curve = bytes(n * 7 % 251 for n in range(2048))
    island.sdo_write(0x8001, 0, curve)
    assert island.sdo_read(0x8001, 0, 2048) == curve


def test_pysoem_uses_complete_access(master):
    island = master.slaves[0]
    island.sdo_write(0x8000, 1, bytes.fromhex("0a000000 0b00"), ca=True)
    assert island.sdo_read(0x8000, 0, 64, ca=True) == bytes.fromhex("0200 0a000000 0b00")


def test_files_in_boot(master):
    island = master.slaves[0]
    lead(master, pysoem.INIT_STATE)
    island.state = pysoem.BOOT_STATE
    island.write_state()
    assert island.state_check(pysoem.BOOT_STATE, TIMEOUT_US) == pysoem.BOOT_STATE
    for size in (1, 244, 488, 20_000):  # 244 fill one message, 488 two
        content = bytes(n % 253 for n in range(size))
        assert island.foe_write("firmware.bin", 0, content) == 1
        assert island.foe_read("firmware.bin", 0, size + 1) == content
    island.state = pysoem.INIT_STATE
    island.write_state()


def test_thousand_cycles_in_op(master):
    operate(master)
    island = master.slaves[0]
    assert master.expected_wkc == 9
    wrong = 0
    for cycle in range(CYCLES):
        island.output = cycle.to_bytes(2, "little") + b"\x01"
        wrong += exchange(master) != 9
    assert wrong == 0
    exchange(master)
    assert island.input == (CYCLES - 1).to_bytes(2, "little") + b"\x01"
    assert master.state_check(pysoem.OP_STATE, TIMEOUT_US) == pysoem.OP_STATE


def test_sdo_beside_process_data(master):
    operate(master)
    assert master.slaves[0].sdo_read(0x1018, 1) == (0x1234).to_bytes(4, "little")
    assert exchange(master) == master.expected_wkc


def test_drive_is_switched_on_by_control_words(master):
    operate(master)
    drive = master.slaves[1]
    for word, status in ((6, 0x21), (7, 0x23), (15, 0x27)):
        for _ in range(3):
            drive.output = word.to_bytes(2, "little") + (1000).to_bytes(4, "little")
            exchange(master)
        assert drive.input[0] & 0x6F == status
    exchange(master)
    assert drive.input[2:6] == (1000).to_bytes(4, "little")


def test_clocks_and_sync0(master):
    master.config_map()
    assert master.config_dc()
    master.slaves[1].dc_sync(act=True, sync0_cycle_time=1_000_000)
    go_to_op(master)
    assert exchange(master) == master.expected_wkc


def difference_ns(slave):
    """Difference of a slave's clock from the reference clock, as the slave reports it."""
    value = int.from_bytes(slave._fprd(0x092C, 4), "little")
    return value & 0x7FFF_FFFF


def test_clocks_follow_the_reference(master):
    master.config_map()
    assert master.config_dc()
    go_to_op(master)
    for _ in range(CYCLES):
        exchange(master)
    assert all(difference_ns(each) < 200 for each in master.slaves[1:])


def test_mapping_by_sdo(master):
    island = master.slaves[0]
    try:
        for sub, octets in ((0, "00"), (1, "10010060"), (2, "10010060"), (0, "02")):
            island.sdo_write(0x1A00, sub, bytes.fromhex(octets))
        master.config_map()
        assert len(island.input) == 4
        go_to_op(master)
        island.output = b"\x34\x12\0"
        for _ in range(3):
            exchange(master)
        assert island.input == bytes.fromhex("3412 3412")
    finally:
        lead(master, pysoem.PREOP_STATE)
        island.sdo_write(0x1A00, 0, b"\0")
        for sub, octets in ((1, "10010060"), (2, "01020060"), (3, "07000000"), (0, "03")):
            island.sdo_write(0x1A00, sub, bytes.fromhex(octets))


def test_entry_that_cannot_be_mapped(master):
    island = master.slaves[0]
    island.sdo_write(0x1A00, 0, b"\0")
    island.sdo_write(0x1A00, 1, bytes.fromhex("20010080"))
    with pytest.raises(pysoem.SdoError) as caught:
        island.sdo_write(0x1A00, 0, b"\1")
    assert caught.value.abort_code == 0x06040041
    island.sdo_write(0x1A00, 1, bytes.fromhex("10010060"))
    island.sdo_write(0x1A00, 0, b"\3")


def test_value_by_command(bus, master):
    operate(master)
    island = master.slaves[0]
    where = {"slave": "island", "entry": "level"}
    assert bus.fault(set={**where, "value": 0x4321}) == {"ok": True}
    island.output = b"\x34\x12\0"
    for _ in range(3):
        exchange(master)
    assert island.input[:2] == b"\x21\x43"
    assert bus.fault(release=where) == {"ok": True}
    for _ in range(2):
        exchange(master)
    assert island.input[:2] == b"\x34\x12"


def test_pysoem_gets_emergencies(bus, master):
    island = master.slaves[0]
    heard = []
    island.add_emergency_callback(heard.append)
    assert bus.fault(kind="emergency", slave="island", code=0x5010) == {"ok": True}

    def is_heard():
        island.mbx_receive()  # looks once and does not wait
        return heard

    wait_until(is_heard)
    assert [(each.error_code, each.error_reg) for each in heard] == [(0x5010, 1)]
    assert bus.fault(kind="emergency", slave="island", code=0x5010, end=True) == {"ok": True}
    heard.clear()
    wait_until(is_heard)
    assert [(each.error_code, each.error_reg) for each in heard] == [(0, 0)]


def test_slow_eeprom_is_waited_for(bus, master):
    drive = master.slaves[1]
    drive.eeprom_write(0x20, b"\x12\x34")
    assert drive.eeprom_read(0x20)[:2] == b"\x12\x34"
    assert bus.fault(kind="eeprom", slave="drive", delay_us=5000) == {"ok": True}
    try:
        assert drive.eeprom_read(0x20)[:2] == b"\x12\x34"
    finally:
        bus.fault(kind="eeprom", slave="drive", end=True)


def test_pysoem_reads_the_eeprom(master):
    island = master.slaves[0]
    assert island.eeprom_read(8) == (0x1234).to_bytes(4, "little")
    assert island.eeprom_read(0x0A) == (0x5678).to_bytes(4, "little")


def test_watchdog_is_reported(master):
    operate(master)
    island = master.slaves[0]

    def is_reported():  # pysoem's own wait is for a state without error
        master.read_state()
        return island.state == pysoem.SAFEOP_STATE | pysoem.STATE_ERROR

    wait_until(is_reported)
    assert island.al_status == 0x001B


def test_slave_without_power_is_missed(bus, master):
    operate(master)
    try:
        assert bus.fault(kind="power", slave="plain") == {"ok": True}
        assert exchange(master) == 6
    finally:
        bus.fault(kind="power", slave="plain", end=True)


RING = """
bus: ring
ring: true
slaves:
  - {name: a, kind: generic, inputs: [{name: in, type: UINT}]}
  - {name: b, kind: generic, inputs: [{name: in, type: UINT}]}
  - {name: c, kind: generic, inputs: [{name: in, type: UINT}]}
"""


def test_ring_goes_on_with_a_cut_cable(tmp_path):
    path = tmp_path / "ring.yaml"
    path.write_text(RING)
    with (
        veth_pair(),
        simulator(path, f"ethernet://{FAR}", "--second", f"ethernet://{FAR_2}") as running,
    ):
        found = pysoem.Master()
        found.open(NEAR, NEAR_2)
        try:
            assert found.config_init() == 3
            operate(found)
            assert exchange(found) == 3
            assert running.fault(kind="cut", slave="b") == {"ok": True}
            assert exchange(found) == 3
            found.state = pysoem.INIT_STATE
            found.write_state()
        finally:
            found.close()


@pytest.mark.parametrize("name", ["io", "terminals"])
def test_soem_exchanges_as_many_bytes_of_each_slave_as_our_master(tmp_path, name):
    path = write_bus(tmp_path) if name == "terminals" else CONFIG_BUSES / f"{name}.yaml"
    ours = sizes_of(path)
    with veth_pair(), simulator(path):
        found = pysoem.Master()
        found.open(NEAR)
        try:
            assert found.config_init() == len(ours)
            operate(found)
            assert [(len(each.output), len(each.input)) for each in found.slaves] == ours
            found.state = pysoem.INIT_STATE
            found.write_state()
        finally:
            found.close()


def test_soem_drives_the_devices_of_esi_files():
    """Coupler, terminals and drive of config/esi; the drive follows in CSP with SYNC0."""
    with veth_pair(), simulator(CONFIG_BUSES / "cell.yaml"):
        found = pysoem.Master()
        found.open(NEAR)
        try:
            assert found.config_init() == 5
            drive = found.slaves[4]
            drive.sdo_write(0x6060, 0, b"\x08")
            found.config_map()
            assert found.config_dc()
            drive.dc_sync(act=True, sync0_cycle_time=1_000_000)
            go_to_op(found)
            sizes = [(len(each.output), len(each.input)) for each in found.slaves]
            assert sizes == [(0, 0), (1, 0), (0, 1), (0, 8), (6, 7)]
            for word, status in ((6, 0x21), (7, 0x23), (15, 0x27)):
                for _ in range(3):
                    drive.output = word.to_bytes(2, "little") + (1000).to_bytes(4, "little")
                    exchange(found)
                assert drive.input[0] & 0x6F == status
            exchange(found)
            assert drive.input[2:6] == (1000).to_bytes(4, "little")
            found.state = pysoem.INIT_STATE
            found.write_state()
        finally:
            found.close()
