"""Frames of type 5 as datagrams and on Ethernet: answers and dropped frames."""

from __future__ import annotations

from typing import TYPE_CHECKING, cast

import pytest

from eap.ams.transport_table import Transport
from eap.runtime.drop_counters import DropReason
from eap.runtime.handover import PortName
from eap.services.gateway.gateway_transport import GatewayTable, GatewayTransport
from eap.services.transports.mailbox_frames import ChannelSender, MailboxIntake
from tests.support import aoe
from tests.support.routing import demultiplexer, station

if TYPE_CHECKING:
    from eap.services.gateway.gateway import MailboxGateway

TARGET = "1.1.1.1.2.1"


class Wire:
    """A channel that keeps what it is to send, and an origin."""

    def __init__(self, headroom: bytes = b"", minimum_size: int = 0, sender: str = "peer") -> None:
        self.minimum_size = minimum_size
        self.sent: list[tuple[str, bytes]] = []
        self._headroom = headroom
        self._sender = sender
        self.is_broken = False

    def link_header(self, destination):
        return destination.encode() + self._headroom if self._headroom else b""

    def send(self, frames, now_ns):
        self.sent += [(frame.destination, bytes(frame.buffer)) for frame in frames]
        return frames if self.is_broken else ()

    def sender_of(self, data):
        return self._sender


def tell(wire: Wire, frame: bytes, *, for_many: bool = False, room: int = 0) -> DropReason | None:
    there = station(TARGET)
    sender = ChannelSender(wire)
    there.add_transport(Transport("link", room), sender)
    intake = MailboxIntake(
        demultiplexer(there), GatewayTransport(GatewayTable(), {}), sender, lambda data: for_many
    )
    return intake.receive(memoryview(frame + bytes(20)), len(frame), 0, wire)


def ask(target: str = TARGET, **more) -> bytes:
    return aoe.frame(aoe.packet(target, 4, b"abc"), **more)


def test_answer_goes_to_the_sender():
    wire = Wire()
    assert tell(wire, ask()) is None
    ((destination, frame),) = wire.sent
    assert destination == "peer"
    assert aoe.answer(frame).data == b"\4cba"


def test_answer_has_the_headers_and_minimum_size_of_its_channel():
    wire = Wire(b"!", 90)
    tell(wire, ask())
    ((_, frame),) = wire.sent
    assert frame.startswith(b"peer!")
    assert len(frame) == 90
    assert aoe.answer(frame[5:]).data == b"\4cba"


def test_frame_without_sender_address_gets_no_answer():
    wire = Wire(sender="")
    assert tell(wire, ask()) is DropReason.MAILBOX
    assert wire.sent == []


def test_answers_fit_the_transport():
    wire = Wire()
    tell(wire, aoe.frame(aoe.packet(TARGET, 4, b"x" * 200)), room=100)
    assert len(wire.sent) > 1
    assert all(len(aoe.opened(frame)) <= 100 for _, frame in wire.sent)


def test_frame_that_the_network_does_not_take():
    wire = Wire()
    wire.is_broken = True
    assert ChannelSender(wire).send("peer", (b"x" * 32,)) == "the network accepted no frame"


@pytest.mark.parametrize(("for_many", "answers"), [(False, 1), (True, 0)])
def test_unknown_target_is_answered_unless_frame_was_multicast(for_many, answers):
    wire = Wire()
    assert tell(wire, ask("9.9.9.9.9.9"), for_many=for_many) is None
    assert len(wire.sent) == answers


def test_dropped_frame_has_a_reason():
    assert tell(Wire(), ask(kind=3)) is DropReason.MAILBOX


@pytest.mark.parametrize(
    ("frame", "behind", "for_many", "reason"),
    [
        (ask(), [], False, None),
        (ask()[:-1], [], False, DropReason.TRUNCATED),
        (ask(kind=3), [], False, DropReason.MAILBOX),
        (ask(kind=3), ["a gateway"], False, None),
        (ask(kind=3), ["a gateway"], True, DropReason.MAILBOX),
    ],
)
def test_drop_reason_does_not_handle_the_frame(frame, behind, for_many, reason):
    table = GatewayTable()
    table.replace({PortName(name, "bus0"): cast("MailboxGateway", object()) for name in behind})
    gateway = GatewayTransport(table, dict.fromkeys(behind, "udp:eap0"))
    sender = ChannelSender(Wire())
    intake = MailboxIntake(demultiplexer(station(TARGET)), gateway, sender, lambda data: for_many)
    assert intake.drop_reason(memoryview(frame + bytes(9)), len(frame), 0, Wire()) is reason
