from __future__ import annotations

import pytest

from devicebus.master.expected import ExpectedSlave
from eap.appliance.engine.bus_settings import master_settings
from eap.pd.spec import BusPortSpec, BusSlaveSpec, PortKind, PortSpec
from tests.support.cyclic import MS


def port(interface, **more):
    return PortSpec("bus0", PortKind.BUS, interface, "1.1.1.1.1.1", bus=BusPortSpec(**more))


def test_described_slaves_are_expected():
    slaves = (BusSlaveSpec("a", 1001, 1, 2), BusSlaveSpec("b", 1002, 3, 4, 5, 6, 7))
    assert master_settings(port("sim://x", slaves=slaves), 1000).expected == [
        ExpectedSlave(name="a", vendor=1, product=2),
        ExpectedSlave(name="b", vendor=3, product=4, revision=5, serial=6, alias=7),
    ]


@pytest.mark.parametrize(
    ("interface", "cycle_us", "octets", "patience_ms"),
    [
        ("ethernet://eth9", 1000, 3000, 5),
        ("ethernet://eth9", 250, 1536, 5),
        ("ethernet://eth9", 10_000, 30_000, 20),
        ("ethernet://eth9", 1_000_000, 3_000_000, 50),
        ("udp://127.0.0.1", 1000, 3000, 30),
        ("sim://x.yaml", 20_000, 60_000, 40),
    ],
)
def test_settings_follow_the_cycle(interface, cycle_us, octets, patience_ms):
    settings = master_settings(port(interface, clocks=True), cycle_us, 7)
    assert settings.acyclic_octets == octets
    assert settings.frame_timeout_ns == patience_ms * MS
    assert (settings.clocks, settings.epoch_offset_ns) == (True, 7)
    assert settings.expected == []
