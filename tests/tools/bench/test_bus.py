"""Figures of bus cycles, and the frame of a cycle."""

from __future__ import annotations

from devicebus.wire.datagram import Command, iter_datagrams
from tools.bench.bus import OCTETS, figures_of, frame
from tools.bench.figures import Decision
from tools.bench.stations import ETHERNET_HEADER


def test_frame_of_a_cycle_has_the_process_data_of_all_slaves() -> None:
    (datagram,) = iter_datagrams(frame()[ETHERNET_HEADER:])
    assert (datagram.header.command, len(datagram.data)) == (Command.LRW, OCTETS)


def test_cycles_are_compared_by_round_with_each_kind_of_slaves() -> None:
    ours, soem, c = [[4e3, 60e3], [2e3, 60e3]], [[4e3, 50e3], [4e3, 50e3]], [[120e3], [120e3]]
    fast, simulated, beside_c = figures_of(ours, soem, c)
    assert (fast.value, fast.decision, fast.limit) == (
        1.2,
        Decision.OK,
        "the C loop: 120.0 thousand/s",
    )
    assert (simulated.value, simulated.limit) == (0.75, "")
    assert beside_c.measured == "0.50 (60.0 of 120.0 thousand/s)"
