"""Entries by what people call them."""

from __future__ import annotations

import pytest

from devicebus.sim.devices.build import build_slave
from devicebus.sim.findentry import find_entry
from devicebus.sim.spec import EntrySpec, ObjectSpec
from tests.support.bus import generic


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
