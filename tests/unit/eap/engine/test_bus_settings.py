from __future__ import annotations

import pytest

from devicebus.master.link import CEILING_NS, RETRIES
from devicebus.master.matching import ExpectedSlave
from eap.engine.bus_settings import master_settings
from eap.ids import InterfaceUri, NetId
from eap.pd.spec import BusPortSpec, BusSlaveSpec, PortKind, PortSpec
from tests.support.cyclic import MS


def port(interface, **more):
    return PortSpec(
        "bus0",
        PortKind.BUS,
        InterfaceUri.parse(interface),
        NetId.parse("1.1.1.1.1.1"),
        bus=BusPortSpec(**more),
    )


def test_described_slaves_are_expected():
    slaves = (BusSlaveSpec("a", 1001, 1, 2), BusSlaveSpec("b", 1002, 3, 4, 5, 6, 7))
    assert master_settings(port("sim://x", slaves=slaves), 1000).expected == [
        ExpectedSlave(name="a", vendor=1, product=2),
        ExpectedSlave(name="b", vendor=3, product=4, revision=5, serial=6, alias=7),
    ]


@pytest.mark.parametrize(
    ("cycle_us", "octets"),
    [(1000, 3000), (250, 1536), (10_000, 30_000), (1_000_000, 3_000_000)],
)
def test_settings_follow_the_cycle(cycle_us, octets):
    settings = master_settings(port("ethernet://eth9", clocks=True), cycle_us, 7)
    assert settings.acyclic_octets == octets
    assert (settings.clocks, settings.epoch_offset_ns) == (True, 7)
    assert settings.expected == []


def test_settings_of_frames_are_those_of_the_plant_file():
    settings = master_settings(port("sim://x", frame_timeout_us=5000, frame_retries=1), 1000)
    assert (settings.frame_timeout_ns, settings.frame_retries) == (5 * MS, 1)
    settings = master_settings(port("sim://x"), 1000)
    assert (settings.frame_timeout_ns, settings.frame_retries) == (CEILING_NS, RETRIES)
