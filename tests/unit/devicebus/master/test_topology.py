from __future__ import annotations

import pytest

from devicebus.master.topology import find_joints, open_ports
from devicebus.sim.wiring import dl_status
from devicebus.wire.register import DlStatus


def status(*ports):
    return DlStatus.decode(dl_status(frozenset(ports)).to_bytes(2, "little"))


@pytest.mark.parametrize("ports", [(), (0,), (0, 1), (0, 1, 2, 3)])
def test_open_ports(ports):
    assert open_ports(status(*ports)) == ports


def parents(*ports):
    return [(joint.parent, joint.parent_port) for joint in find_joints([status(*p) for p in ports])]


def test_a_line():
    assert parents((0, 1), (0, 1), (0,)) == [(None, 0), (0, 1), (1, 1)]


def test_branches_are_left_at_port_3_first_and_then_1_and_2():
    assert parents((0, 1, 2, 3), (0, 1), (0,), (0,), (0,)) == [
        (None, 0),
        (0, 3),
        (1, 1),
        (0, 1),
        (0, 2),
    ]


def test_ports_that_lead_nowhere_and_slaves_without_any_are_tolerated():
    assert parents((0, 1), (0, 1)) == [(None, 0), (0, 1)]
    assert parents((0,), ()) == [(None, 0), (None, 0)]
    assert find_joints([status(1, 2)])[0].entry_port == 1
    assert find_joints([]) == ()
