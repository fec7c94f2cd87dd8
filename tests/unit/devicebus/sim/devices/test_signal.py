"""Inputs that change by themselves, in virtual time."""

from __future__ import annotations

import pytest

from devicebus.sim.devices.objects import build_dictionary
from devicebus.sim.devices.signal import Signals, read_csv
from devicebus.sim.spec import ChannelSpec
from devicebus.wire.alstatus import AlState
from tests.support.bus import generic

MS = 1_000_000


OUTPUT = ChannelSpec(name="out", type="INT")


def make(*inputs, resources=None):
    spec = generic(inputs=inputs, outputs=(OUTPUT,))
    dictionary = build_dictionary(spec, 5001)
    return Signals(spec, dictionary, resources or {}), dictionary


def values(signals, dictionary, times_ms):
    found = []
    for at in times_ms:
        signals.step(AlState.SAFEOP, at * MS)
        found.append(dictionary.entry(0x6000, 1).value)
    return found


def test_signals_without_sources_are_false():
    signals, _ = make(ChannelSpec(name="a"))
    assert not signals


def test_values_come_round():
    made = make(ChannelSpec(name="a", type="INT", values=(1, 2, 3), period_ms=10))
    assert values(*made, (100, 109, 110, 120, 130)) == [1, 1, 2, 3, 1]


def test_values_from_a_file():
    resources = {"x.csv": b"# title\n\n1.4;old\n-7\n"}
    made = make(ChannelSpec(name="a", type="INT", csv="x.csv", period_ms=1), resources=resources)
    assert values(*made, (0, 1, 2)) == [1, -7, 1]


def test_values_are_cut_to_the_type():
    made = make(ChannelSpec(name="a", type="SINT", values=(1000, -1000), period_ms=1))
    assert values(*made, (0, 1)) == [127, -128]
    made = make(ChannelSpec(name="a", values=(0, 5), period_ms=1))
    assert values(*made, (0, 1)) == [False, True]
    made = make(ChannelSpec(name="a", type="REAL", values=(0.5,), period_ms=1))
    assert values(*made, (0,)) == [0.5]


def test_signals_noise_is_bounded_and_repeatable():
    channel = ChannelSpec(name="a", type="INT", value=100, noise=5, period_ms=1)
    first = values(*make(channel), range(200))
    assert first == values(*make(channel), range(200))
    assert min(first) >= 95
    assert max(first) <= 105
    assert len(set(first)) > 5


def test_input_follows_an_output():
    signals, dictionary = make(ChannelSpec(name="a", type="INT", follows="out"))
    dictionary.entry(0x7000, 1).value = -3
    assert values(signals, dictionary, (0,)) == [-3]


def test_signals_refuse_an_unknown_output():
    with pytest.raises(ValueError, match="a follows 'x', which is no output"):
        make(ChannelSpec(name="a", follows="x"))


@pytest.mark.parametrize(
    ("octets", "message"), [(b"1\nx\n", "f.csv:2: 'x' is not a number"), (b"# none\n", "no values")]
)
def test_file_that_holds_no_numbers(octets, message):
    with pytest.raises(ValueError, match=message):
        read_csv(octets, "f.csv")
