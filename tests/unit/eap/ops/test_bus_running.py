"""The bus of a running station, asked over its control socket."""

from __future__ import annotations

from contextlib import ExitStack

import pytest

from devicebus.errors import AlStatusError, BusError, FrameLostError, MailboxTimeoutError
from devicebus.mailbox import coe_client
from devicebus.mailbox.conversation import MailboxRequest
from devicebus.master.procedure import Sleep, read
from devicebus.wire.alstatus import AlState
from devicebus.wire.register import Register
from eap.codec.mailbox import MailboxType
from eap.errors import ControlError
from eap.od.abort import SdoAbortError
from eap.ops.bus_running import open_running
from eap.runtime.engine_messages import ExchangeMailbox
from tests.support.appliance import wait_until
from tests.support.fakeappliance import Appliance

pytestmark = pytest.mark.net


@pytest.fixture
def works(tmp_path, monkeypatch):
    """Plant ``works``: station press has bus0 (coe)."""
    monkeypatch.setenv("EAP_RUNTIME_DIR", str(tmp_path / "run"))
    with ExitStack() as stack:
        appliance = Appliance("works", ["press"], stack, ["coe"])
        appliance.wait_served()
        yield appliance


@pytest.fixture
def bus(works):
    with open_running("press", "bus0", "works") as running:
        yield running


def vendor(sizes):
    del sizes
    return coe_client.upload(0x1018, 1)


def states(bus):
    return [slave.status.state for slave in bus.scan()]


def test_scan(bus):
    coupler, buttons, sensor = bus.scan()
    assert (coupler.station, coupler.name, coupler.parent) == (1001, "coupler", None)
    assert (buttons.parent, buttons.ports) == (0, (0, 1))
    assert (sensor.vendor, sensor.status.state, sensor.fault) == (0xE5A, AlState.OP, "")


def test_conversations(bus):
    sensor = bus.find("sensor")
    assert bus.converse(sensor, vendor, "vendor") == b"\x5a\x0e\0\0"
    calls = []
    curve = bus.converse(
        sensor, lambda _: coe_client.upload(0x8001, 0), "curve", lambda: calls.append(1)
    )
    assert (len(curve), bool(calls)) == (2048, True)
    with pytest.raises(SdoAbortError):
        bus.converse(sensor, lambda _: coe_client.upload(0x5555, 0), "nothing")
    assert bus.converse(sensor, vendor, "vendor") == b"\x5a\x0e\0\0"  # each gave its turn back


def test_errors_reach_the_conversation(bus, works):
    sensor = bus.find("sensor")
    works.lines[0].fault(kind="mailbox", slave="sensor")

    def careful(sizes):
        assert sizes.to_slave > 16
        try:
            yield MailboxRequest(MailboxType.COE, bytes(10), timeout_ns=5_000_000)
        except MailboxTimeoutError:
            return "late"

    assert bus.converse(sensor, careful, "careful") == "late"


def test_slave_without_a_mailbox(bus):
    bus.bring([bus.find("sensor")], AlState.INIT)
    with pytest.raises(BusError, match=r"slave 1003 \(sensor\) has no mailbox in INIT"):
        bus.converse(bus.find("sensor"), vendor, "vendor")


def test_states(bus, works):
    bus.bring(bus.scan(), AlState.SAFEOP)
    assert states(bus) == [AlState.SAFEOP] * 3
    bus.bring([bus.find("buttons")], AlState.OP)
    assert states(bus) == [AlState.SAFEOP, AlState.OP, AlState.SAFEOP]
    works.lines[0].fault(kind="refuse", slave="sensor", state="OP", code=0x1D)
    with pytest.raises(AlStatusError) as caught:
        bus.bring([bus.find("sensor")], AlState.OP)
    assert caught.value.code == 0x1D


def test_procedures(bus, works):
    octets = bus.run(read(1003, Register.STATION_ADDRESS, 2))
    assert int.from_bytes(octets, "little") == 1003

    def sleeper():
        _, before_ns = yield Sleep(0)
        _, now_ns = yield Sleep(10_000_000)
        return now_ns - before_ns

    assert bus.run(sleeper()) >= 10_000_000
    works.lines[0].fault(kind="loss")
    with pytest.raises(FrameLostError):
        bus.run(read(1003, Register.TYPE, 1))


def test_scan_of_a_silent_bus_names_the_cause(bus, works):
    works.lines[0].fault(kind="loss")
    message = ""

    def is_named():
        nonlocal message
        with pytest.raises(FrameLostError) as caught:
            bus.scan()
        message = str(caught.value)
        return message.startswith("no frame comes back")

    wait_until(is_named)
    assert message.startswith("no frame comes back: 3 slaves cannot be reached; check the")


def test_frames_are_counted(bus):
    counts = bus.frame_counts()
    assert counts.sent >= counts.received > 0
    assert (counts.late, counts.lost, counts.retried) == (0, 0, 0)
    assert counts.timeout_us > counts.round_trip_us >= 0


def test_closed_conversation_releases_the_slave(bus, works):
    bus.find("sensor")

    def stuck(sizes):
        del sizes
        yield MailboxRequest(MailboxType.COE, bytes.fromhex("00204018100100000000"))
        raise KeyboardInterrupt

    with (
        pytest.raises(KeyboardInterrupt),
        open_running("press", "bus0") as other,
    ):
        other.converse(other.find("sensor"), stuck, "stuck")
    works.wait_served()
    farewell = works.engine.of(ExchangeMailbox)[-1]
    assert (farewell.station, farewell.request.expects_reply) == (1003, False)
    assert bus.converse(bus.find("sensor"), vendor, "vendor") == b"\x5a\x0e\0\0"


def test_bus_that_is_not_there(works):
    with pytest.raises(ControlError, match="did you mean press"), open_running("pres", "bus0"):
        pass
    with open_running("press", "bus1") as bus, pytest.raises(ControlError, match="no port 'bus1'"):
        bus.scan()
