"""Answers as frames, with statistics and log lines; what they say is in test_gateway."""

from __future__ import annotations

import pytest

from eap.codec.mailbox import MailboxHeader, MailboxType, decode_frame
from eap.gateway.error_table import Cause
from eap.gateway.request_tracker import RequestTracker
from eap.ids import Endpoint
from eap.services.gateway.reply_encoder import (
    ErrorLog,
    GatewayRequest,
    GatewayStatistics,
    ReplyEncoder,
)
from eap.services.gateway.sessions import GatewayReply, error_replies

HERE = Endpoint("udp:eap0", "127.0.0.1:1")
NEAR, THERE = Endpoint("udp:eap0", "10.0.0.8:1"), Endpoint("udp:eap0", "10.0.0.9:1")
COE = MailboxType.COE


@pytest.fixture
def sent():
    return []


@pytest.fixture
def request_(sent):
    return GatewayRequest(MailboxHeader(0, 0x9000, type=COE), bytes(10), HERE, sent.append)


def encoder(*, is_silent: bool = False) -> tuple[ReplyEncoder, RequestTracker]:
    tracker = RequestTracker()
    tracker.admit(HERE, b"request", 0)
    return ReplyEncoder(tracker, ErrorLog("mill/bus0"), is_silent=is_silent), tracker


def test_reply_encoder_counts_the_messages_of_each_slave(request_, sent):
    gateway, _ = encoder()
    replies = [GatewayReply(COE, b"a"), GatewayReply(COE, b"b"), GatewayReply(COE, b"c")]
    gateway.answer(request_, 1001, 0x9000, replies, 1000)
    headers = [decode_frame(frame)[0] for frame in sent]
    assert [each.counter for each in headers] == [1, 2, 3]
    assert {each.address for each in headers} == {0x9000}
    gateway.send(sent.append, 1001, COE, b"another slave")
    gateway.send(sent.append, 0x9000, COE, b"d")
    assert [decode_frame(frame)[0].counter for frame in sent[3:]] == [1, 4]
    (row,) = gateway.statistics.report()
    assert (row["address"], row["requests"], row["replies"]) == (1001, 1, 3)


@pytest.mark.parametrize("is_silent", [False, True])
def test_errors_are_counted_whether_they_are_sent_or_not(request_, sent, is_silent):
    gateway, tracker = encoder(is_silent=is_silent)
    gateway.reply_error(request_, Cause.CROWDED)
    gateway.answer(request_, 0, 0, error_replies(COE, bytes(10), Cause.DENIED), 0)
    gateway.answer_dialect(request_, COE, b"no", Cause.DENIED, 0)
    assert len(sent) == (0 if is_silent else 3)
    assert tracker.counts_of(HERE).errors == 3
    gateway.answer_dialect(request_, COE, b"yes", None, 0)
    assert decode_frame(sent[-1])[1] == b"yes"
    assert tracker.counts_of(HERE).errors == 3


def test_statistics_have_a_row_for_each_slave_and_protocol() -> None:
    statistics = GatewayStatistics()
    statistics.count(1001, MailboxType.COE, [None], 2_000_000)
    statistics.count(1001, MailboxType.COE, [None, None], 4_000_000)
    statistics.count(1001, MailboxType.COE, [Cause.TIMEOUT], 900_000_000)
    statistics.count(0, MailboxType.FOE, [Cause.NO_PROTOCOL], 1)
    statistics.count(1001, MailboxType.FOE, [], 1)
    master, coe, foe = statistics.report()
    assert coe == {
        "address": 1001,
        "protocol": "COE",
        "requests": 3,
        "replies": 3,
        "errors": {"timeout": 1},
        "last_error": "it did not answer in time",
        "mean_us": 3000.0,
        "slowest_us": 4000.0,
    }
    assert (master["address"], master["errors"], master["mean_us"]) == (0, {"no_protocol": 1}, None)
    assert (foe["requests"], foe["replies"], foe["last_error"]) == (1, 0, "")


def test_statistics_of_every_address_there_is_are_bounded() -> None:
    statistics = GatewayStatistics()
    for address in range(6000):
        statistics.count(address, MailboxType.COE, [Cause.NO_SLAVE], 1)
    assert len(statistics.report()) == 4096


def test_refusal_log_names_client_address_and_cause(caplog):
    log = ErrorLog("mill/bus0")
    log.write(NEAR, 1001, MailboxType.COE, Cause.DENIED)
    log.write(NEAR, 1009, MailboxType.COE, Cause.NO_SLAVE)
    (line,) = caplog.messages
    assert line == (
        "gateway mill/bus0: COE of 10.0.0.8:1 (udp:eap0) to address 1001 refused: access refused:"
        " the plant file has no rule that allows it"
    )


def test_refusal_log_names_a_remote_slave_as_the_plant_does(caplog):
    log = ErrorLog("mill/bus0", {0x9001: "press/bus0/drive"}, 0.9)
    log.write(NEAR, 0x9001, MailboxType.COE, Cause.TIMEOUT, is_overdue=True)
    log.write(NEAR, 1001, MailboxType.COE, Cause.TIMEOUT)
    log.write(NEAR, 1002, MailboxType.COE, Cause.BUS_DOWN, is_overdue=True)
    start = "gateway mill/bus0: COE of 10.0.0.8:1 (udp:eap0) to address"
    assert caplog.messages == [
        f"{start} 0x9001 (press/bus0/drive) failed: it did not answer in time (answer_ms 900)",
        f"{start} 1001 failed: it did not answer in time",
        f"{start} 1002 failed: the bus is down",
    ]


def test_error_log_repeats_of_one_client_have_the_same_cause(caplog):
    log = ErrorLog("mill/bus0")
    again = NEAR._replace(connection="10.0.0.8:2")
    for endpoint in (NEAR, again, THERE):
        log.write(endpoint, 1001, MailboxType.COE, Cause.DENIED)
    log.write(NEAR, 1002, MailboxType.COE, Cause.DENIED)
    first, second, *others = (record.cause for record in caplog.records)
    assert first == second
    assert len({first, *others}) == 3
