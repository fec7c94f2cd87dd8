"""Dictionaries, written whole in the order that a device needs."""

from __future__ import annotations

from pathlib import Path

import pytest

from eap.config.load import blank
from eap.device.eap_dictionary import EapDictionary
from eap.device.eap_spec import fill, read_back
from eap.errors import ControlError
from eap.od.dictionary import ObjectDictionary
from eap.od.model import RW, Entry, OdState, record
from eap.ops.od import LoadedEntries, load
from eap.runtime.plantfile import load_plant
from tests.support.oddevice import MemoryDevice, mixer

CONFIG = Path(__file__).parents[4] / "config"


def test_loaded_entries_are_written_in_order():
    indexes = [0xF800, 0x8000, 0xE000, 0xD000, 0x1A00, 0x2000, 0x7001, 0x6000, 0x1600]
    device = MemoryDevice(
        ObjectDictionary(
            record(index, "", {0: Entry("", "USINT", RW), 1: Entry("", "UINT", RW)})
            for index in indexes
        )
    )
    entries = [(index, sub, bytes((1,) * (2 if sub else 1))) for index in indexes for sub in (0, 1)]
    assert load(device, entries) == LoadedEntries(18, 0)
    order = [0x6000, 0x7001, 0x1600, 0x1A00, 0x2000, 0xD000, 0xE000, 0x8000, 0xF800]
    assert list(dict.fromkeys(index for index, _, _ in device.written)) == order
    assert [step[1:] for step in device.written if step[0] == 0x1A00] == [
        (0, b"\0"),
        (1, b"\1\1"),
        (0, b"\1"),
    ]
    assert [step[1] for step in device.written if step[0] == 0x8000] == [1, 0]


def test_load_leaves_equal_entries_unchanged():
    device = MemoryDevice(mixer())
    entries = [(0x1A00, 0, b"\1"), (0x1A00, 1, (0x60000120).to_bytes(4, "little"))]
    entries += [(0xD000, 7, bytes(4)), (0xF200, 1, b"\x02\0")]
    assert load(device, entries) == LoadedEntries(1, 3)
    assert device.written == [(0xD000, 7, bytes(4))]


@pytest.mark.parametrize("name", ["demo", "solar-line", "triggers"])
def test_dump_of_a_station_loads_into_a_blank_one(name):
    plant = load_plant(CONFIG / f"{name}.yaml").plant
    assert plant is not None
    bare = blank("spare", "udp://127.9.9.9", "127.9.9.9.2.1", 10_000).plant
    assert bare is not None
    for spec in plant.stations:
        full = EapDictionary(spec, "eap0")
        fill(full)
        spare = EapDictionary(bare.stations[0], "eap0")
        fill(spare)
        contents = MemoryDevice(full).contents()
        entries = [
            (each.object.index, each.entry.subindex, each.octets)
            for each in contents
            if "w" in each.entry.access and each.octets is not None
        ]
        load(MemoryDevice(spare), entries)
        got = read_back(bare.stations[0], {"eap0": spare})
        assert (got.frames, got.subscriptions) == (spec.frames, spec.subscriptions)


def test_load_refusal_names_the_written_entries():
    device = MemoryDevice(mixer())
    entries = [(0x6000, 9, bytes(4)), (0xD000, 8, bytes(2))]
    with pytest.raises(ControlError, match=r"0xD000:08: .*; 1 entry was written before"):
        load(device, entries)
    device.state = OdState.OP
    with pytest.raises(ControlError, match=r"0xD000:07: .*; nothing was written before"):
        load(device, [(0xD000, 7, bytes(4))])
