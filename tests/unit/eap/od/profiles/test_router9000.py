from __future__ import annotations

from itertools import pairwise

import pytest

from eap.codec import datatypes
from eap.od.model import RO
from eap.od.profiles import router9000 as profile
from eap.od.profiles.table import UNITS

ENTRIES = [(row, entry) for row in profile.ALL for entry in row.entries]


def _id(pair):
    row, entry = pair
    return f"{row.first:04X}:{entry.subindex:02X}"


@pytest.mark.parametrize(("row", "entry"), ENTRIES, ids=map(_id, ENTRIES))
def test_every_entry_is_named_described_read_only_and_of_a_type(row, entry):
    assert entry.name
    assert entry.description.endswith(".")
    assert row.description.endswith(".")
    assert entry.unit in UNITS
    assert entry.access == RO
    kind = datatypes.parse(entry.kind)
    if entry.default is not None:
        kind.encode(entry.default)
    if entry.live:
        assert entry.live in set(profile.RouterLive)


def test_ranges_do_not_overlap():
    ends = [(row.first, row.last) for row in profile.ALL]
    assert all(before[1] < after[0] for before, after in pairwise(ends))


def test_everything_live_is_shown_once():
    shown = [entry.live for _, entry in ENTRIES if entry.live]
    assert sorted(shown) == sorted(profile.RouterLive)


def test_device_type_is_that_of_a_router():
    (entry,) = next(row.entries for row in profile.ALL if row.first == 0x1000)
    assert entry.default == 9000 << 16 | 5001
