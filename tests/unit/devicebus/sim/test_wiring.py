"""The way of a frame through lines, branches, rings and broken cables."""

from __future__ import annotations

from devicebus.sim.wiring import CABLE_NS, FORWARD_NS, Side, dl_status, find_way

HOP = FORWARD_NS + CABLE_NS


def links(*cables, ring_end=None, master=True):
    found = {(0, 0): Side.PRIMARY} if master else {}
    for child, parent, port in cables:
        found[child, 0] = parent, port
        found[parent, port] = child, 0
    if ring_end is not None:
        found[ring_end] = Side.SECONDARY
    return found


def test_line_is_worked_off_in_its_order():
    way = find_way(links((1, 0, 1), (2, 1, 1)), (0, 0))
    assert (way.order, way.comes_out, way.closed_at) == ((0, 1, 2), Side.PRIMARY, None)
    assert way.arrivals == {
        (0, 0): 0, (1, 0): HOP, (2, 0): 2 * HOP, (1, 1): 3 * HOP, (0, 1): 4 * HOP,
    }  # fmt: skip


def test_branches_go_in_the_order_3_1_2():
    way = find_way(links((1, 0, 1), (2, 0, 2), (3, 0, 3), (4, 3, 1)), (0, 0))
    assert way.order == (0, 3, 4, 1, 2)


def test_single_slave():
    way = find_way(links(), (0, 0))
    assert (way.order, way.arrivals) == ((0,), {(0, 0): 0})


def test_whole_ring_is_worked_off_from_one_side_only():
    ring = links((1, 0, 1), (2, 1, 1), ring_end=(2, 1))
    assert find_way(ring, (0, 0)).order == (0, 1, 2)
    assert find_way(ring, (0, 0)).comes_out is Side.SECONDARY
    back = find_way(ring, (2, 1))
    assert (back.order, back.comes_out) == ((), Side.PRIMARY)


def test_broken_ring_is_worked_off_from_both_sides():
    ring = links((1, 0, 1), (3, 2, 1), ring_end=(3, 1))
    first = find_way(ring, (0, 0))
    assert (first.order, first.comes_out, first.closed_at) == ((0, 1), Side.PRIMARY, None)
    second = find_way(ring, (3, 1))
    assert (second.order, second.comes_out, second.closed_at) == ((2, 3), Side.SECONDARY, 0)


def test_long_line_needs_no_deep_stack():
    cables = [(n, n - 1, 1) for n in range(1, 3000)]
    assert find_way(links(*cables), (0, 0)).order == tuple(range(3000))


def test_dl_status_of_a_captured_controller():
    # SOEM with one LAN9252, frame 94 of the capture in tests/vectors: 1756.
    assert dl_status(frozenset({0})) == 0x5617
    assert dl_status(frozenset({0, 1})) == 0x5A37
