"""Descriptions: what may be left out, and the ranges that a loader can see."""

from __future__ import annotations

import msgspec
import pytest

from devicebus.sim.spec import BusSpec, DeviceKind

SMALL = {"bus": "b", "slaves": [{"name": "x", "kind": "generic"}]}


def test_slave_spec_needs_name_and_kind():
    bus = msgspec.convert(SMALL, BusSpec)
    (slave,) = bus.slaves
    assert (slave.kind, slave.mailbox.coe, slave.after) == (DeviceKind.GENERIC, True, "")


@pytest.mark.parametrize(
    ("key", "value"),
    [("vendor", -1), ("alias", 0x10000), ("port", 0), ("port", 4), ("mailbox", {"size": 31}),
     ("mailbox", {"size": 1487}), ("clock", {"drift_ppm": 1001})],
)  # fmt: skip
def test_ranges(key, value):
    slave = {**SMALL["slaves"][0], key: value}
    with pytest.raises(msgspec.ValidationError, match=key):
        msgspec.convert({**SMALL, "slaves": [slave]}, BusSpec)


def test_no_mailbox_is_said_by_null():
    slave = {**SMALL["slaves"][0], "mailbox": None}
    assert msgspec.convert({**SMALL, "slaves": [slave]}, BusSpec).slaves[0].mailbox is None
