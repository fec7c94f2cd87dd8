"""Steps and datagrams as words of the control protocol, there and back."""

from __future__ import annotations

from typing import get_args

import pytest

from devicebus.errors import BusError
from devicebus.mailbox.conversation import MailboxRequest
from devicebus.wire.datagram import Command, DatagramReply, DatagramRequest, fprd
from eap.codec.mailbox import MailboxType
from eap.control.bus import (
    BUS_TRANSFER,
    BusAskParameters,
    Protocol,
    datagram_row,
    kind_of,
    protocol_of,
    reply_row,
    request_parameters,
    to_datagram,
    to_octets,
    to_replies,
    to_request,
)
from eap.control.protocol import parameters
from eap.errors import ControlError


@pytest.mark.parametrize(
    "ask",
    [
        MailboxRequest(MailboxType.COE, b"\x01\xff"),
        MailboxRequest(
            MailboxType.FOE, b"", listen=True, timeout_ns=3_000_000_000, delay_ns=10_000_000
        ),
        MailboxRequest(MailboxType.VOE, b"x", expects_reply=False),
    ],
)
def test_step(ask):
    wanted = parameters({"conversation": 1} | request_parameters(ask), BusAskParameters)
    assert to_request(ask.type, wanted) == ask


def test_times_are_rounded_up():
    assert request_parameters(MailboxRequest(MailboxType.COE, b"", timeout_ns=1))["timeout_ms"] == 1


def test_protocols():
    for kind in set(MailboxType) - {MailboxType.ERR}:
        assert kind_of(protocol_of(kind)) is kind


def test_datagrams_and_replies():
    access = fprd(1001, 0x130, 6)
    assert to_datagram(datagram_row(access)) == access
    row = (Command.FPWR, 1, 2, "ff", 0)
    assert to_datagram(row) == DatagramRequest(Command.FPWR, 1, 2, b"\xff")
    replies = [DatagramReply(b"\1\2", 1, 2), DatagramReply(b"", 0)]
    assert to_replies([reply_row(each) for each in replies]) == replies


def test_kind_of_an_unknown_protocol_is_refused():
    with pytest.raises(ControlError, match="99 is no command"):
        to_datagram((99, 0, 0, "", 1))
    with pytest.raises(ControlError, match="'xy' is not pairs"):
        to_octets("xy")
    with pytest.raises(BusError, match="malformed reply"):
        to_replies([(1, "xy", 1)])
    with pytest.raises(ControlError, match="the answer to bus_transfer"):
        BUS_TRANSFER.decode({"replies": [1]})
    with pytest.raises(ControlError, match="timeout_ms"):
        parameters({"conversation": 1, "request": "", "timeout_ms": 10**9}, BusAskParameters)


def test_protocols_are_the_mailbox_types_without_errors():
    assert {kind_of(name) for name in get_args(Protocol)} == {*MailboxType} - {MailboxType.ERR}
