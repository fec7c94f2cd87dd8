"""Requests of services: each is answered once, and none of them disturbs the bus."""

from __future__ import annotations

import os
import socket

import msgspec
import pytest

from devicebus.errors import BusError
from devicebus.mailbox.conversation import MailboxRequest
from devicebus.master.mailboxes import Unsolicited
from devicebus.wire.alstatus import AlState
from devicebus.wire.datagram import AS_SET, Command, DatagramRequest
from devicebus.wire.register import Register
from eap.codec.mailbox import MailboxType
from eap.engine.bus_requests import (
    MAX_OUTSTANDING,
    MAX_PER_SLAVE,
    MAX_TRIES,
    PER_WAKE_UP,
    BusRequestHandler,
    check_datagrams,
)
from eap.errors import EngineRefusedError
from eap.runtime.bus_errors import ErrorRecord
from eap.runtime.engine_messages import (
    BringSlaves,
    BusChange,
    Cancel,
    Configure,
    DescribeBus,
    EngineMessage,
    EngineReply,
    EngineStarted,
    ExchangeDatagrams,
    ExchangeMailbox,
    ForgetFaults,
    Ping,
    Republish,
    SetState,
    UnsolicitedMessage,
)
from tests.support.cyclic import MS
from tests.support.enginebus import BusRig

pytestmark = pytest.mark.net

UPLOAD = bytes.fromhex("0020 40 1810 01 00000000")
"""SDO upload of 0x1018:01."""
SECOND = 1_000_000_000


class Office:
    """A desk in front of one bus, and services at the other end of the pair."""

    def __init__(self, rig):
        self.rig = rig
        self.services, engine = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.services.setblocking(False)
        self.handler = BusRequestHandler(engine, self.serve_station)
        self.handler.add(0, rig.bus)
        self.heard = {}
        self.changes = []
        self.asked = []

    def serve_station(self, request, now_ns, reply):
        """Refuse what concerns one station, and do everything else."""
        self.asked.append((request, now_ns))
        reply(EngineRefusedError("not now") if request.station == "two" else None)

    def post(self, *requests):
        for request in requests:
            self.services.send(msgspec.msgpack.encode(request))
        for _ in range(-(-len(requests) // PER_WAKE_UP)):
            self.handler.serve(self.rig.now_ns)

    def collect(self):
        decoder = msgspec.msgpack.Decoder(EngineMessage)
        while True:
            try:
                message = decoder.decode(self.services.recv(1 << 20))
            except BlockingIOError:
                return self.heard
            if isinstance(message, BusChange):
                self.changes.append(message)
                continue
            assert message.id not in self.heard
            self.heard[message.id] = message

    def ask(self, request, limit_ns=5 * SECOND):
        """Post one request and return its answer."""
        self.post(request)
        self.rig.wait(lambda: request.id in self.collect(), limit_ns)
        return self.heard[request.id]

    def close(self):
        self.services.close()
        self.handler.close()


@pytest.fixture
def office(tmp_path):
    rig = BusRig(tmp_path).start()
    rig.wait_op()
    made = Office(rig)
    yield made
    made.close()


def ask(number, station=1002, request=UPLOAD, kind=MailboxType.COE, **more):
    more.setdefault("timeout_ns", SECOND)
    step = MailboxRequest(kind, request, **more)
    return ExchangeMailbox(id=number, bus=0, station=station, request=step)


def read(number, *commands, adp=1002, ado=Register.AL_STATUS):
    datagrams = tuple(DatagramRequest(command, adp, ado, bytes(2), 3) for command in commands)
    return ExchangeDatagrams(id=number, bus=0, datagrams=datagrams)


def test_a_new_engine_greets(office):
    office.handler.announce()
    message = msgspec.msgpack.decode(office.services.recv(100), type=EngineMessage)
    assert message == EngineStarted(os.getpid())


def test_changes_precede_reply_to_their_request(office):
    office.ask(Republish(id=1, bus=0))
    (first,) = office.changes
    assert first.stations == (1001, 1002, 1003) == tuple(each.station for each in first.slaves)
    office.post(BringSlaves(id=2, bus=0, station=1002, target=AlState.PREOP))
    office.rig.wait(lambda: office.rig.bus.master.slaves[1002].al_state == AlState.PREOP)
    office.rig.run(MS)
    messages = []
    while not messages or "id" not in messages[-1]:
        messages.append(msgspec.msgpack.decode(office.services.recv(1 << 16)))
    states = [slave["state"] for each in messages[:-1] for slave in each["slaves"]]
    assert (states[-1], messages[-1]["id"]) == (AlState.PREOP, 2)


def test_unrequested_changes_come_with_next_publish_or_reply(office):
    office.ask(Republish(id=1, bus=0))
    for number, publish in enumerate((office.handler.publish, lambda: office.post(Ping(id=2)))):
        office.changes.clear()
        office.rig.fault(kind="power", slave="level", for_ms=200)
        office.rig.wait(lambda: office.rig.value("level.state") == 0)
        publish()
        office.collect()
        assert [each.station for each in office.changes[-1].slaves] == [1003]
        assert office.changes[-1].slaves[0].losses == number + 1
        office.rig.wait_op()


def test_a_bus_is_described(office):
    answer = office.ask(DescribeBus(id=7, bus=0))
    assert answer.report.is_up
    assert [(each.station, each.name, each.state) for each in answer.report.slaves] == [
        (1001, "coupler", AlState.OP),
        (1002, "io", AlState.OP),
        (1003, "level", AlState.OP),
    ]


def test_desk_forgets_faults_that_are_over_on_request(office):
    office.rig.fault(kind="power", slave="level", for_ms=50)
    office.rig.run(1_000 * MS)
    assert office.ask(DescribeBus(id=7, bus=0)).report.slaves[2].past_fault == "it does not answer"
    assert office.ask(ForgetFaults(id=8, bus=0)).error is None
    slave = office.ask(DescribeBus(id=9, bus=0)).report.slaves[2]
    assert (slave.past_fault, slave.since_ns, slave.until_ns) == ("", None, None)


def test_a_mailbox_answers(office):
    answer = office.ask(ask(1))
    assert (answer.id, answer.message.data) == (1, bytes.fromhex("0030 43 1810 01 5a0e0000"))
    assert answer.message.counter in range(1, 8)


def test_datagrams_without_reply_are_answered_when_sent(office):
    abort = bytes.fromhex("0020 80 1810 01 00000008")
    reply = office.ask(ask(1, request=abort, expects_reply=False))
    assert (reply.error, reply.message.data) == (None, b"")


def test_unsolicited_message_reaches_services(office):
    (forward,) = office.rig.bus.faults.on_unsolicited
    forward(Unsolicited(1001, MailboxType.EOE, b"frame"))
    message = msgspec.msgpack.decode(office.services.recv(100), type=EngineMessage)
    assert message == UnsolicitedMessage(0, Unsolicited(1001, MailboxType.EOE, b"frame"))


def test_unsolicited_listener_is_called(office):
    answer = office.ask(ask(3, listen=True, timeout_ns=20 * MS))
    assert answer.error.kind == "MailboxTimeoutError"
    assert "no COE reply within 20 ms" in answer.error.message


def test_a_slave_without_a_mailbox_says_so_at_once(office):
    error = office.ask(ask(1, station=1003)).error
    assert "slave 1003 (level) has no mailbox" in error.message
    assert "unknown slave 1234" in office.ask(ask(2, station=1234)).error.message
    assert "Invalid enum value 14" in office.ask(ask(3, kind=14)).error.message


def test_datagrams_are_sent_together(office):
    answer = office.ask(read(1, Command.FPRD, Command.BRD))
    assert [(each.wkc, each.data[0], each.tries) for each in answer.replies] == [
        (1, AlState.OP, 1),
        (3, AlState.OP, 1),
    ]


def test_lost_datagrams_are_an_answer_too(office):
    office.rig.wire.is_deaf = True
    assert office.ask(read(1, Command.FPRD)).error.kind == "FrameLostError"


@pytest.mark.parametrize(
    "command", [Command.BWR, Command.BRW, Command.LRW, Command.LWR, Command.LRD, Command.FRMW]
)
def test_datagrams_that_disturb_slaves_are_rejected(office, command):
    error = office.ask(read(1, Command.FPRD, command)).error
    assert f"command {int(command)}: it would disturb" in error.message


@pytest.mark.parametrize(
    ("request_", "reason"),
    [
        (ExchangeDatagrams(id=1, bus=0, datagrams=()), "0 datagrams, expected 1 to 256"),
        (read(1, *[Command.NOP] * 257), "257 datagrams"),
        (read(1, Command.FPRD, ado=0x10000), "expected addresses of 16 bits"),
        (
            ExchangeDatagrams(id=1, bus=0, datagrams=(DatagramRequest(4, 1, 1, b"", 1),)),
            "with 0 bytes",
        ),
        (DescribeBus(id=1, bus=1), "there is no bus 1"),
        (DescribeBus(id=1, bus=-1), "no bus -1"),
        (BringSlaves(id=1, bus=0, station=0, target=5), "malformed request: Invalid enum value 5"),
        (read(1, 77), "malformed request: Invalid enum value 77"),
        (BringSlaves(id=1, bus=0, station=9, target=8), "unknown slave 9"),
    ],
)
def test_invalid_bus_requests_are_rejected(office, request_, reason):
    assert reason in office.ask(request_).error.message


def test_slaves_are_brought_and_kept(office):
    assert office.ask(BringSlaves(id=1, bus=0, station=1003, target=AlState.PREOP)).error is None
    office.rig.run(2 * MS)
    assert office.rig.value("level.state") == AlState.PREOP
    assert office.ask(BringSlaves(id=2, bus=0, station=0, target=AlState.SAFEOP)).error is None
    office.rig.run(300 * MS)
    assert office.rig.value("state") == AlState.SAFEOP


def test_messages_that_are_none_are_counted(office):
    office.services.send(b"\xc1")
    office.services.send(msgspec.msgpack.encode({"do": "everything"}))
    office.post(DescribeBus(id=1, bus=0))
    assert office.handler.malformed == 2
    report = office.collect()[1].report
    assert (report.malformed, report.dropped) == (2, 0)


def test_only_some_are_taken_at_a_time(office):
    for number in range(PER_WAKE_UP + 3):
        office.services.send(msgspec.msgpack.encode(DescribeBus(id=number, bus=0)))
    office.handler.serve(office.rig.now_ns)
    assert len(office.collect()) == PER_WAKE_UP
    office.handler.serve(office.rig.now_ns)
    assert len(office.collect()) == PER_WAKE_UP + 3


def test_one_slave_has_so_many_requests_and_the_others_theirs(office):
    office.post(*[ask(number) for number in range(MAX_PER_SLAVE + 1)])
    office.post(ask(1000, station=1001))
    heard = office.collect()
    assert list(heard) == [MAX_PER_SLAVE]
    assert "64 requests to slave 1002 are under way" in heard[MAX_PER_SLAVE].error.message
    office.rig.wait(lambda: len(office.collect()) == MAX_PER_SLAVE + 2)
    assert sum(1 for each in office.heard.values() if each.error is None) == MAX_PER_SLAVE + 1
    assert office.ask(ask(2000)).error is None


def test_all_together_have_an_end_too(office, monkeypatch):
    monkeypatch.setattr("eap.engine.bus_requests.MAX_OUTSTANDING", 3)
    assert MAX_OUTSTANDING == 1024
    office.post(ask(1), ask(2), ask(3, station=1001), read(4, Command.FPRD))
    assert "3 requests are under way already" in office.collect()[4].error.message


def test_cancelled_request_gets_no_reply(office):
    office.post(ask(1, listen=True), ask(2), Cancel(id=1), Cancel(id=99))
    office.rig.wait(lambda: 2 in office.collect())
    office.rig.run(1500 * MS)
    assert list(office.collect()) == [2]
    assert office.rig.bus.tasks == set()


def test_reused_request_number_replaces_old_request(office):
    office.post(ask(5, listen=True), ask(5))
    office.rig.wait(lambda: 5 in office.collect())
    assert office.heard[5].message.data[:3] == bytes.fromhex("003043")


def test_replies_not_read_are_dropped(office):
    for number in range(2000):
        office.services.send(msgspec.msgpack.encode(DescribeBus(id=number, bus=0)))
        office.handler.serve(office.rig.now_ns)
    assert office.handler.dropped > 0
    read_ = len(office.collect())
    assert read_ + office.handler.dropped == 2000
    assert office.ask(ask(5000)).error is None
    assert office.ask(DescribeBus(id=5001, bus=0)).report.dropped == office.handler.dropped


def test_without_services_nothing_happens(office):
    office.services.close()
    office.handler.serve(office.rig.now_ns)
    office.handler.announce()
    assert office.handler.dropped == 1


def test_station_request_is_forwarded_and_answered_when_done(office):
    configure = Configure(id=1, station="one", path="/a.spec")
    refused = SetState(id=2, station="two", state=4)
    office.post(configure, refused, Ping(id=3))
    assert office.asked == [(configure, office.rig.now_ns), (refused, office.rig.now_ns)]
    answers = office.collect()
    assert answers[1] == EngineReply(id=1)
    assert answers[2].error == ErrorRecord("EngineRefusedError", "not now")
    assert answers[3] == EngineReply(id=3)


@pytest.mark.parametrize(("wanted", "made"), [(-1, AS_SET), (0, AS_SET), (5, 5), (1000, MAX_TRIES)])
def test_tries_have_bounds(wanted, made):
    (access,) = check_datagrams((DatagramRequest(Command.BRD, 0, 0, b"\0", wanted),))
    assert access.tries == made


@pytest.mark.parametrize(
    "datagram",
    [
        DatagramRequest(Command.FPRD, -1, 0, b"\0", 1),
        DatagramRequest(Command.FPRD, 0, 0x10000, b"\0", 1),
        DatagramRequest(Command.FPRD, 0, 0, b"", 1),
        DatagramRequest(Command.FPRD, 0, 0, bytes(1487), 1),
    ],
)
def test_datagram_that_fits_no_frame_is_rejected(datagram):
    assert len(check_datagrams((DatagramRequest(Command.FPRD, 0, 0, bytes(1486), 1),))) == 1
    with pytest.raises(BusError, match="expected addresses of 16 bits and 1 to 1486 bytes"):
        check_datagrams((datagram,))
