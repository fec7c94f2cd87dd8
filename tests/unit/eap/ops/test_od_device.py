"""Both kinds of devices fit the protocol."""

from __future__ import annotations

from eap.ops.od import OdDevice
from eap.ops.od_devices import SlaveOd, StationOd


def test_both_kinds_have_all_of_it():
    names = {name for name in vars(OdDevice) if not name.startswith("_")}
    assert {"objects", "describe", "entry", "read", "write", "contents"} == names
    for kind in (StationOd, SlaveOd):
        assert names <= set(vars(kind))
