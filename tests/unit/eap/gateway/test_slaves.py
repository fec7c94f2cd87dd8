"""Slaves as a master's dictionary tells of them; the reading is in test_client."""

from __future__ import annotations

import pytest

from devicebus.errors import BusError
from eap.gateway.slaves import MasterSlave, sizes_of

DRIVE = MasterSlave(1001, "drive", 1, 2, 3, 4, 512, 256, 8)
COUPLER = MasterSlave(1002, "coupler", 1, 2, 3, 4, 0, 0, 8)


def test_mailboxes() -> None:
    sizes = sizes_of([DRIVE, COUPLER], 1001)
    assert (sizes.to_slave, sizes.to_master) == (512, 256)
    with pytest.raises(BusError, match=r"1002 \(coupler\) has no mailbox"):
        sizes_of([DRIVE, COUPLER], 1002)
    with pytest.raises(BusError, match="known slaves: none"):
        sizes_of([], 1)
