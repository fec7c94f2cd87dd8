"""Requests to the engine and its answers, as they travel."""

from __future__ import annotations

import msgspec
import pytest

from devicebus.mailbox.conversation import MailboxMessage, MailboxRequest
from devicebus.wire.alstatus import AlState
from devicebus.wire.datagram import Command, DatagramReply, DatagramRequest
from eap.codec.mailbox import MailboxType
from eap.runtime.bus_errors import ErrorRecord
from eap.runtime.engine_messages import (
    BringSlaves,
    BusReport,
    Cancel,
    Configure,
    DescribeBus,
    EngineMessage,
    EngineReply,
    EngineRequest,
    EngineStarted,
    ExchangeDatagrams,
    ExchangeMailbox,
    Ping,
    SetState,
    SlaveReport,
    StationRequest,
)

READ = DatagramRequest(Command.FPRD, 1001, 0x130, bytes(6), 3)
COE, FOE = MailboxType.COE, MailboxType.FOE
SLAVE = SlaveReport(
    station=1001, name="a", vendor=1, product=2, revision=3, serial=4, alias=5, state=8, target=8
)


@pytest.mark.parametrize(
    "request_",
    [
        DescribeBus(id=1, bus=0),
        ExchangeMailbox(id=2, bus=1, station=1001, request=MailboxRequest(COE, b"\xff\0")),
        ExchangeMailbox(id=3, bus=0, station=1, request=MailboxRequest(FOE, b"", True, 1)),
        ExchangeDatagrams(id=4, bus=0, datagrams=(READ,)),
        BringSlaves(id=5, bus=0, station=0, target=AlState.OP),
        Ping(id=6),
        Cancel(id=2**62),
        Configure(id=7, station="one", path="/run/a.spec"),
        SetState(id=8, station="one", state=4),
    ],
)
def test_engine_request_survives_msgpack(request_):
    assert msgspec.msgpack.decode(msgspec.msgpack.encode(request_), type=EngineRequest) == request_


@pytest.mark.parametrize(
    "message",
    [
        EngineStarted(7),
        EngineReply(id=1),
        EngineReply(id=2, message=MailboxMessage(COE, b"\0\1", 5, 7)),
        EngineReply(id=3, error=ErrorRecord("FoeError", "not found", 0x8001)),
        EngineReply(id=4, replies=(DatagramReply(b"\1", 1, 2), DatagramReply(b"", 0))),
        EngineReply(id=5, report=BusReport(is_up=True, slaves=(SLAVE,), cycles=9)),
    ],
)
def test_engine_message_survives_msgpack(message):
    assert msgspec.msgpack.decode(msgspec.msgpack.encode(message), type=EngineMessage) == message


def test_engine_requests_are_decoded_by_tag():
    octets = msgspec.msgpack.encode(Configure(id=1, station="a", path="/x"))
    assert msgspec.msgpack.decode(octets) == {
        "do": "configure",
        "id": 1,
        "station": "a",
        "path": "/x",
    }
    octets = msgspec.msgpack.encode(SetState(id=2, station="a", state=4))
    decoded = msgspec.msgpack.decode(octets, type=StationRequest)
    assert decoded == SetState(id=2, station="a", state=4)
