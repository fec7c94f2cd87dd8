"""A master for the length of one command."""

from __future__ import annotations

import pytest

from devicebus.errors import AlStatusError, BusError, FrameLostError
from devicebus.mailbox import coe_client
from devicebus.wire.alstatus import AlState
from eap.ids import InterfaceUri
from eap.ops.bus_session import open_bus
from tests.support.loopbus import LoopBus

VENDOR = b"\x5a\x0e\0\0"


@pytest.fixture
def line():
    return LoopBus("coe")


def vendor_of(bus, name):
    return bus.converse(bus.find(name), lambda sizes: coe_client.upload(0x1018, 1), "vendor")


def states(line):
    with line.session() as bus:
        return [slave.status.state for slave in bus.scan()]


def test_scan_changes_nothing(line):
    with line.session() as bus:
        assert [(unit.station, unit.name) for unit in bus.scan()] == [
            (1001, "coupler"),
            (1002, "buttons"),
            (1003, "sensor"),
        ]
    assert states(line) == [AlState.INIT] * 3


@pytest.mark.parametrize("name", ["1003", "0x3EB", "sensor"])
def test_slave_by_address_and_by_name(line, name):
    with line.session() as bus:
        assert bus.find(name).station == 1003


def test_slave_that_is_not_there(line):
    with (
        line.session() as bus,
        pytest.raises(BusError, match=r"unknown slave 'x'.*1001 \(coupler\)"),
    ):
        bus.find("x")


def test_slave_in_init_is_brought_to_preop(line):
    with line.session() as bus:
        assert vendor_of(bus, "sensor") == VENDOR
    assert states(line) == [AlState.INIT, AlState.INIT, AlState.PREOP]


@pytest.mark.parametrize("delay_us", [0, 100, 1000])
def test_answers_are_taken_however_soon_they_come(line, delay_us):
    line.fault(kind="delay", delay_us=delay_us)
    with line.session() as bus:
        assert vendor_of(bus, "sensor") == VENDOR
        counts = bus.frame_counts()
    assert (counts.received, counts.lost) == (counts.sent, 0)


def test_states_of_all(line):
    with line.session() as bus:
        bus.bring(bus.scan(), AlState.OP)
    assert states(line) == [AlState.OP] * 3
    with line.session() as bus:
        bus.bring(bus.scan(), AlState.OP)
        bus.bring([bus.find("sensor")], AlState.BOOT)
    assert states(line) == [AlState.OP, AlState.OP, AlState.BOOT]


def test_one_refuses(line):
    line.fault(kind="refuse", slave="sensor", state="PREOP", code=0x51)
    with line.session() as bus, pytest.raises(AlStatusError, match="EEPROM error"):
        bus.bring(bus.scan(), AlState.PREOP)


def test_request_without_an_appliance_fails(line):
    line.fault(kind="loss")
    with line.session() as bus, pytest.raises(FrameLostError):
        bus.scan()


def test_meanwhile_is_called(line):
    calls = []
    with line.session() as bus:
        unit = bus.find("sensor")
        bus.converse(
            unit, lambda sizes: coe_client.upload(0x8001, 0), "curve", lambda: calls.append(1)
        )
    assert calls


def test_frames_are_counted(line):
    with line.session() as bus:
        bus.scan()
        stats = bus.frame_counts()
    assert stats.sent == stats.received > 0


@pytest.mark.net
def test_open_bus_without_an_answer_fails():
    with open_bus(InterfaceUri.parse("udp://127.0.4.10")) as bus, pytest.raises(FrameLostError):
        bus.scan()
