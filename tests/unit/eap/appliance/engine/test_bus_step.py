from __future__ import annotations

import pytest

from devicebus.errors import BusError
from devicebus.mailbox.conversation import MailboxMessage, MailboxRequest
from devicebus.master.access import AS_SET, DatagramReply, DatagramRequest
from devicebus.master.procedure import StepResult
from devicebus.wire.datagram import Command
from eap.appliance.bus_request import AskMailbox, Datagram, Transfer
from eap.appliance.engine.bus_step import MAX_TRIES, one_ask, one_step, to_accesses, to_ask
from eap.codec.mailbox import MailboxType


def transfer(*datagrams):
    return Transfer(id=1, bus=0, datagrams=datagrams)


def test_a_message_keeps_all_that_was_asked():
    request = AskMailbox(
        id=1, bus=0, station=1001, type=4, request=b"x", listen=True, timeout_ns=5, delay_ns=6,
        expects_reply=False,
    )  # fmt: skip
    ask = to_ask(request)
    assert ask == MailboxRequest(MailboxType.FOE, b"x", True, 5, 6, False)
    conversation = one_ask(ask)
    assert next(conversation) == ask
    with pytest.raises(StopIteration) as end:
        conversation.send(MailboxMessage(MailboxType.FOE, b"reply"))
    assert end.value.value == MailboxMessage(MailboxType.FOE, b"reply")


def test_a_protocol_that_is_none_is_named():
    with pytest.raises(BusError, match="no mailbox protocol 9"):
        to_ask(AskMailbox(id=1, bus=0, station=1, type=9, request=b"", timeout_ns=1))


def test_datagrams_go_out_and_come_back_in_one_step():
    accesses = to_accesses(transfer(Datagram(4, 1001, 0x130, bytes(2), 0)))
    assert accesses == [DatagramRequest(Command.FPRD, 1001, 0x130, bytes(2))]
    procedure = one_step(accesses)
    assert next(procedure) == accesses
    with pytest.raises(StopIteration) as end:
        procedure.send(StepResult((DatagramReply(b"\x08\0", 1, 2),), 0))
    assert end.value.value == [DatagramReply(b"\x08\0", 1, 2)]


@pytest.mark.parametrize(("wanted", "made"), [(-1, AS_SET), (0, AS_SET), (5, 5), (1000, MAX_TRIES)])
def test_tries_have_bounds(wanted, made):
    (access,) = to_accesses(transfer(Datagram(7, 0, 0, b"\0", wanted)))
    assert access.tries == made


@pytest.mark.parametrize("command", [8, 9, 10, 11, 12, 13, 14, 15, -1])
def test_what_writes_to_all_or_is_logical_is_refused(command):
    with pytest.raises(BusError, match=f"command {command}: it would disturb .* expected one of"):
        to_accesses(transfer(Datagram(command, 0, 0, b"\0", 1)))


@pytest.mark.parametrize(
    "datagram",
    [
        Datagram(4, -1, 0, b"\0", 1),
        Datagram(4, 0, 0x10000, b"\0", 1),
        Datagram(4, 0, 0, b"", 1),
        Datagram(4, 0, 0, bytes(1487), 1),
    ],
)
def test_what_fits_no_frame_is_refused(datagram):
    assert len(to_accesses(transfer(Datagram(4, 0, 0, bytes(1486), 1)))) == 1
    with pytest.raises(BusError, match="expected addresses of 16 bits and 1 to 1486 octets"):
        to_accesses(transfer(datagram))
