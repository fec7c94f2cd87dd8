"""What a running segment obeys."""

from __future__ import annotations

import json
from contextlib import suppress

import pytest
from hypothesis import given
from hypothesis import strategies as st

from devicebus.sim import command as commands
from devicebus.sim.fault import FaultySegment
from devicebus.sim.spec import ChannelSpec, FaultKind
from devicebus.wire.alstatus import AlState
from devicebus.wire.datagram import Command, encode_frame
from tests.support.bus import Bench, datagram, generic

SET = b'{"set": {"slave": "slave", "entry": "limit", "value": true}}'
RELEASE = b'{"release": {"slave": "slave", "entry": "limit"}}'


def obey(faulty, octets, now_ns):
    commands.obey(faulty, json.loads(octets), now_ns)


@pytest.fixture
def bench():
    inputs = (ChannelSpec(name="limit", values=(0,)), ChannelSpec(name="echo", follows="valve"))
    return Bench(generic(inputs=inputs, outputs=(ChannelSpec(name="valve"),)))


def inputs(bench):
    return bench.cycle().data[1]


def test_input_is_what_it_was_set_to_until_it_is_released(bench):
    faulty = FaultySegment(bench.segment)
    bench.bring(AlState.OP)
    assert inputs(bench) == 0
    obey(faulty, SET, bench.now_ns)
    assert [inputs(bench) for _ in range(3)] == [1, 1, 1]
    obey(faulty, RELEASE, bench.now_ns)
    assert inputs(bench) == 0


def test_slave_that_does_not_run_yet_has_the_value_when_it_does(bench):
    faulty = FaultySegment(bench.segment)
    obey(faulty, SET, 0)
    bench.bring(AlState.OP)
    assert inputs(bench) == 1


def test_output_is_set_for_the_device_too(bench):
    faulty = FaultySegment(bench.segment)
    bench.bring(AlState.OP)
    obey(faulty, SET.replace(b"limit", b"valve"), 0)
    assert inputs(bench) == 2
    assert inputs(bench) == 2


def test_faults_begin_and_end(bench):
    faulty = FaultySegment(bench.segment)
    obey(faulty, b'{"kind": "power", "slave": "slave"}', 0)
    assert not bench.slaves[0].is_powered
    obey(faulty, b'{"kind": "power", "slave": "slave", "end": true}', 0)
    assert bench.slaves[0].is_powered


@pytest.mark.parametrize(
    ("command", "reason"),
    [
        (b"[]", "a JSON object"),
        (b"3", "a JSON object"),
        (b"{}", "kind"),
        (b'{"kind": "loss", "evry": 2}', "no key 'evry' .one of kind, .*every.*, end"),
        (b'{"kind": "power", "slave": "x"}', "no slave 'x'"),
        (SET.replace(b'"slave": "slave"', b'"slave": "x"'), "no slave 'x' .one of slave"),
        (SET.replace(b"limit", b"limt"), "no entry 'limt'"),
        (SET.replace(b"true", b'"on"'), "is not a value of BOOL"),
        (SET.replace(b"true", b"null"), "value"),
        (RELEASE, "limit was not set"),
        (b'{"set": {}}', "slave"),
        (b'{"tx": 1, "kind": "tx-pdo"}', "tx"),
        (b'{"kind": "tx-pdo", "slave": "slave", "object": "0x1600"}', "is no TxPDO"),
    ],
)
def test_refusals(bench, command, reason):
    with pytest.raises(ValueError, match=reason):
        obey(FaultySegment(bench.segment), command, 0)


VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3),
    max_leaves=3,
)


@given(
    st.sampled_from(("limit", "valve", "0x1008", "0x1018:1", "0x1A00:0", "0x7000:0")),
    VALUES,
    st.sampled_from(FaultKind),
)
def test_nothing_but_value_errors(entry, value, kind):
    bench = Bench(generic())
    faulty = FaultySegment(bench.segment)
    commands = (
        {"set": {"slave": "slave", "entry": entry, "value": value}},
        {"release": {"slave": "slave", "entry": value}},
        {"kind": kind.value, "slave": "slave", "object": entry, "code": value},
        value,
    )
    for command in commands:
        with suppress(ValueError):
            obey(faulty, json.dumps(command).encode(), 0)
    faulty.receive_frame(bytearray(encode_frame([datagram(Command.BRD, 0, 0, b"\0")])), 10**9)
