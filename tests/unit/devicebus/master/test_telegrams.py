"""Telegrams of SoE drives: lists that the master writes and reads, and process data from them."""

from __future__ import annotations

import pytest

from devicebus.errors import BusError
from devicebus.master.pdo import ProcessDataChannel, channels_from_sii
from devicebus.master.telegrams import read_telegrams
from devicebus.wire.alstatus import AlState
from eap.od.slave_config import MappedObject, SlaveConfig
from tests.unit.devicebus.sim.devices.test_esi_play import SOE, converse, device_of, wire

STATUS, FEEDBACK, COMMAND = (
    MappedObject(*each) for each in ((135, 0, 16), (51, 0, 32), (47, 0, 32))
)

# As vendors have it: control word and status word are fixed, and in no list.
FIXED = SOE
for _word in (134, 135):
    FIXED = FIXED.replace(f"<Entry><Index>{_word}<", f'<Entry Fixed="true"><Index>{_word}<')


def preop(config=None):
    line = wire(device_of(FIXED), config or SlaveConfig(fixed_pdos=True))
    line.wait(line.core.bring_up(line.now_ns, AlState.PREOP))
    return line


def idns(channels):
    return [[[each.index for each in pdo.entries] for pdo in each.pdos] for each in channels]


def test_telegrams_of_two_drives_are_read():
    line = preop()
    channels = channels_from_sii(line.core.slaves[1001].found.sii)
    found = converse(line, lambda _: read_telegrams(channels))
    assert found == channels
    assert idns(found) == [[[134, 47], [134, 47]], [[135, 51], [135, 51]]]


def test_list_in_the_mapping_is_written_and_lays_out_the_process_data():
    mapping = {16: (STATUS, FEEDBACK, COMMAND)}
    line = wire(device_of(FIXED), SlaveConfig(fixed_pdos=True, mapping=mapping))
    line.wait(line.core.bring_up(line.now_ns))
    inputs = [each for each in line.core.image.layout.variables if not each.is_output]
    assert [(each.index, each.subindex, each.bit_offset) for each in inputs] == [
        (135, 0, 0), (51, 0, 16), (47, 0, 48), (135, 0, 80), (51, 0, 96),
    ]  # fmt: skip
    assert line.segment.slaves[0].state is AlState.OP
    # The list is written again after a loss of power.
    line.segment.switch(0, on=False)
    line.elapse(200_000_000)
    line.segment.switch(0, on=True)
    line.elapse(2_000_000_000)
    assert line.segment.slaves[0].state is AlState.OP


def test_sync_manager_without_pdos_has_the_telegram_of_the_first_drive():
    line = preop()
    bare = (ProcessDataChannel(2, 0, 0, True, ()), ProcessDataChannel(3, 0, 0, False, ()))
    found = converse(line, lambda _: read_telegrams(bare))
    assert idns(found) == [[[134, 47]], [[135, 51]]]
    assert [each.size for each in found] == [6, 6]


def test_list_that_the_drive_refuses_is_named():
    wrong = {24: (MappedObject(134, 0, 16), MappedObject(99, 0, 16))}
    line = wire(device_of(FIXED), SlaveConfig(fixed_pdos=True, mapping=wrong))
    with pytest.raises(BusError, match=r"slave 1001: PDO configuration in PS: .*S-0-0024"):
        line.wait(line.core.bring_up(line.now_ns))
