from __future__ import annotations

import msgspec
import pytest

from eap.od.slave_config import (
    IdnWrite,
    MappedObject,
    OpMode,
    RevisionRule,
    SdoWrite,
    SlaveConfig,
    SyncSignals,
    Transition,
)

MS = 1_000_000


def test_transition_up_is_towards_op():
    assert [each for each in Transition if each.is_up] == ["IP", "PS", "SO"]


def test_config_survives_the_handover():
    config = SlaveConfig(
        assignment={2: (0x1600,)},
        mapping={0x1600: (MappedObject(0x6040, 0, 16),)},
        writes=(
            SdoWrite(index=0x6060, data=b"\x08"),
            IdnWrite(at=(Transition.SO, Transition.OS), idn=0x8001, data=b"\x01\x00", drive=1),
        ),
        sync=OpMode(name="DC"),
    )
    assert msgspec.json.decode(msgspec.json.encode(config), type=SlaveConfig) == config
    assert msgspec.msgpack.decode(msgspec.msgpack.encode(config), type=SlaveConfig) == config


@pytest.mark.parametrize(
    ("mode", "signals"),
    [
        (OpMode(), SyncSignals(activate=0x300, cycle0_ns=2 * MS)),
        (OpMode(cycle0_ns=MS, shift0_ns=500), (0x300, MS, 500, 0)),
        (OpMode(factor0=3), (0x300, 6 * MS, 0, 0)),
        (OpMode(factor0=-4, shift0_factor=-2), (0x300, MS // 2, MS // 4, 0)),
        # SYNC1 by itself follows SYNC0 by its shift.
        (OpMode(activate=0x700, shift1_ns=10), (0x700, 2 * MS, 0, 10)),
        # SYNC1 every second SYNC0: the register has the time from SYNC0 to SYNC1.
        (OpMode(activate=0x700, factor1=2, shift1_ns=10), (0x700, 2 * MS, 0, 2 * MS + 10)),
        # SYNC0 four times a cycle, SYNC1 once, by the bus cycle.
        (OpMode(activate=0x730, factor0=-4, factor1=-1), (0x730, MS // 2, 0, 2 * MS - MS // 2)),
        (OpMode(activate=0x730, cycle1_ns=3 * MS), (0x730, 2 * MS, 0, MS)),
    ],
)
def test_signals_of_an_op_mode(mode, signals):
    found = mode.signals(2 * MS)
    if isinstance(signals, SyncSignals):
        assert found == signals
    else:
        assert msgspec.structs.astuple(found) == signals


def test_op_mode_without_activation_has_no_signals():
    assert OpMode(activate=0).signals(MS) is None


@pytest.mark.parametrize(
    ("rule", "accepted"),
    [
        ("exact", [0x0012_0001]),
        ("at_least", [0x0012_0001, 0x0012_0002, 0x0013_0000, 0x0013_0001]),
        ("any", [0x0011_0001, 0x0012_0000, 0x0012_0001, 0x0012_0002, 0x0013_0000, 0x0013_0001]),
        ("same_low", [0x0011_0001, 0x0012_0001, 0x0013_0001]),
        ("same_low_at_least", [0x0012_0001, 0x0013_0001]),
        ("same_high", [0x0012_0000, 0x0012_0001, 0x0012_0002]),
        ("same_high_at_least", [0x0012_0001, 0x0012_0002]),
    ],
)
def test_revision_rule_accepts(rule, accepted):
    found = [0x0011_0001, 0x0012_0000, 0x0012_0001, 0x0012_0002, 0x0013_0000, 0x0013_0001]
    assert [each for each in found if RevisionRule(rule).accepts(0x0012_0001, each)] == accepted


def test_revision_rule_describes_what_it_accepts():
    texts = [rule.describe(0x0012_0001) for rule in RevisionRule]
    assert texts == [
        "revision 0x00120001",
        "revision 0x00120001 or later",
        "any revision",
        "a revision that ends in 0001",
        "revision 0x00120001 or a later one that ends in 0001",
        "a revision that begins with 0x0012",
        "revision 0x00120001 or a later one that begins with 0x0012",
    ]
