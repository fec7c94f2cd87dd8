"""Buses built from descriptions."""

from __future__ import annotations

import pytest

from devicebus.sim.devices.build import build_segment, build_slave, complete, device_type
from devicebus.sim.devices.drive import Axes
from devicebus.sim.devices.signal import Signals
from devicebus.sim.segment import SegmentEnd
from devicebus.sim.spec import BusSpec, ChannelSpec, ClockSpec, DeviceKind, MailboxSpec, SlaveSpec
from devicebus.wire.datagram import Command, encode_frame
from eap.codec.mailbox import MailboxType
from tests.support.bus import datagram, generic, send


def spec(kind, **more):
    return SlaveSpec(name="x", kind=DeviceKind(kind), **more)


@pytest.mark.parametrize("kind", ["coupler", "digital", "analogue", "drive", "generic"])
def test_kind_gives_a_product_code_unless_there_is_one(kind):
    assert complete(spec(kind)).product > 0
    assert complete(spec(kind, product=77)).product == 77


def test_kind_fills_the_last_byte_of_each_pdo():
    inputs = (
        ChannelSpec(name="a"),
        ChannelSpec(name="b", type="UINT", pdo=0x1A01),
        ChannelSpec(name="c", type="UINT", bits=12, pdo=0x1A02),
    )
    filled = complete(spec("digital", inputs=inputs)).inputs
    assert filled[:3] == inputs
    assert [(each.object, each.bits, each.pdo) for each in filled[3:]] == [
        ("0", 7, 0),
        ("0", 4, 0x1A02),
    ]


def test_profile_of_a_drive():
    assert (device_type(spec("drive")), device_type(spec("digital"))) == (0x20192, 5001)


def test_build_slave_gives_each_kind_its_behaviour():
    assert isinstance(build_slave(spec("drive")).device.behaviour, Axes)
    assert build_slave(spec("digital")).device.behaviour is None
    noisy = spec("analogue", inputs=(ChannelSpec(name="a", type="INT", noise=1),))
    assert isinstance(build_slave(noisy).device.behaviour, Signals)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (spec("esi", esi="x.xml"), "needs its description"),
        (spec("coupler", inputs=(ChannelSpec(name="a"),)), "has no process data"),
    ],
)
def test_description_that_cannot_be(given, message):
    with pytest.raises(ValueError, match=message):
        build_slave(given)


def bus(*specs, **more):
    return BusSpec(bus="b", slaves=specs, **more)


def test_line_by_default():
    segment = build_segment(bus(generic("a"), generic("b"), generic("c")))
    assert [slave.device.name for slave in segment.slaves] == ["a", "b", "c"]
    assert send(segment, Command.BRD, 0, 0, b"\0").wkc == 3


def test_branch_by_name():
    segment = build_segment(
        bus(generic("a"), generic("b"), generic("c", after="a", port=3), generic("d", after="b"))
    )
    segment.cut(2)
    assert send(segment, Command.BRD, 0, 0, b"\0").wkc == 3
    segment.cut(1)
    assert send(segment, Command.BRD, 0, 0, b"\0").wkc == 1


def test_slave_before_must_come_before():
    with pytest.raises(ValueError, match="b is wired to c, which comes later"):
        build_segment(bus(generic("a"), generic("b", after="c"), generic("c", after="a")))


def test_ring_has_a_second_end():
    segment = build_segment(bus(generic("a"), generic("b"), ring=True))
    frame = bytearray(encode_frame([datagram(Command.BRD, 0, 0, b"\0")]))
    assert segment.process_frame(frame, 0) is SegmentEnd.SECONDARY


def test_clock_as_described():
    slave = build_slave(generic(clock=ClockSpec(drift_ppm=10, start_ns=5, needs_sync0=True)))
    assert slave.esc.clock.local_time(0) == 5
    assert slave.esc.clock.local_time(10**9) == 5 + 10**9 + 10_000
    assert slave.device.needs_sync0
    assert build_slave(generic(clock=None)).esc.read(0x0910, 8, 0) is None


def test_ports_follow_the_wiring():
    segment = build_segment(bus(generic("a"), generic("b", after="a", port=3), generic("c")))
    assert [slave.esc.peek(7, 1)[0] for slave in segment.slaves] == [0xCF, 0x0F, 0x0F]


def test_drive_failed_axis_reports_an_emergency():
    slave = build_slave(SlaveSpec(name="d", kind=DeviceKind.DRIVE, axes=2,
                                  mailbox=MailboxSpec(soe=True)))  # fmt: skip
    slave.device.behaviour.drives[1].fail(0x7500)
    servers = slave.device.mailbox.protocols
    assert servers[MailboxType.COE].messages_to_send(0) == [
        bytes.fromhex("0010 0075 01") + bytes(5)
    ]
    (message,) = servers[MailboxType.SOE].messages_to_send(0)
    assert message[0] == 6 | 1 << 5
    assert message[4:7] == bytes.fromhex("0075 01")
    assert slave.device.dictionary.entry(0x1001, 0).value == 1
    slave.device.behaviour.drives[1].reset()
    assert servers[MailboxType.COE].messages_to_send(0) == [
        bytes.fromhex("0010 0000 00") + bytes(5)
    ]
    assert slave.device.dictionary.entry(0x1001, 0).value == 0


def test_channels_have_names():
    slave = build_slave(generic(inputs=(ChannelSpec(name="gap", type="BIT7", object="0"),
                                        ChannelSpec(name="a"))))  # fmt: skip
    assert slave.device.channels == {"a": (0x6000, 1), "speed": (0x7000, 1), "valve": (0x7000, 2)}


def test_boot_needs_a_mailbox():
    assert build_slave(generic()).device.has_boot
    assert not build_slave(generic(mailbox=None)).device.has_boot
    assert not build_slave(generic(boot=False)).device.has_boot
