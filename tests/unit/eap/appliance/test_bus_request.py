"""Requests to the engine and its answers, as they travel."""

from __future__ import annotations

import msgspec
import pytest

from eap.appliance.bus_request import (
    Answer,
    AskMailbox,
    Bring,
    BusReport,
    Cancel,
    Datagram,
    Describe,
    Failure,
    FromEngine,
    Hello,
    Outcome,
    Ping,
    Request,
    SlaveReport,
    Transfer,
)
from eap.appliance.station_request import Configure, SetState

SLAVE = SlaveReport(
    station=1001, name="a", vendor=1, product=2, revision=3, serial=4, alias=5, state=8, target=8
)


@pytest.mark.parametrize(
    "request_",
    [
        Describe(id=1, bus=0),
        AskMailbox(id=2, bus=1, station=1001, type=3, request=b"\xff\0", timeout_ns=10**10),
        AskMailbox(id=3, bus=0, station=1, type=4, request=b"", timeout_ns=1, listen=True),
        Transfer(id=4, bus=0, datagrams=(Datagram(4, 1001, 0x130, bytes(6), 3),)),
        Bring(id=5, bus=0, station=0, target=8),
        Ping(id=6),
        Cancel(id=2**62),
        Configure(id=7, station="one", path="/run/a.spec"),
        SetState(id=8, station="one", state=4),
    ],
)
def test_requests(request_):
    assert msgspec.msgpack.decode(msgspec.msgpack.encode(request_), type=Request) == request_


@pytest.mark.parametrize(
    "message",
    [
        Hello(7),
        Answer(id=1),
        Answer(id=2, data=b"\0\1"),
        Answer(id=3, failure=Failure("FoeError", "not found", 0x8001)),
        Answer(id=4, outcomes=(Outcome(1, b"\1", 2), Outcome(0, b"", 1))),
        Answer(id=5, report=BusReport(is_up=True, slaves=(SLAVE,), cycles=9)),
    ],
)
def test_answers(message):
    assert msgspec.msgpack.decode(msgspec.msgpack.encode(message), type=FromEngine) == message
