from __future__ import annotations

import logging

import pytest

from eap.aoe.way import Way
from eap.appliance.services.gateway import refusal_log as module
from eap.appliance.services.gateway.refusal_log import BURST, RefusalLog
from eap.codec.mailbox import MailboxType
from eap.gateway.refusal import Reason

HERE, THERE = Way("udp:eap0", "10.0.0.8:1"), Way("udp:eap0", "10.0.0.9:1")


class Clock:
    now = 100.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def lines(caplog):
    caplog.set_level(logging.WARNING)
    return lambda: [record.getMessage() for record in caplog.records]


def test_who_was_refused_what(lines):
    log = RefusalLog("mill/bus0")
    log.write(HERE, 1001, MailboxType.COE, Reason.DENIED)
    log.write(HERE, 1009, MailboxType.COE, Reason.NO_SLAVE)
    (line,) = lines()
    assert line == (
        "gateway mill/bus0: COE of 10.0.0.8:1 (udp:eap0) to address 1001 refused: access refused:"
        " the plant file has no rule that allows it"
    )


def test_one_that_goes_on_trying_hides_no_other(lines):
    clock = Clock()
    log = RefusalLog("mill/bus0", clock)
    for _ in range(BURST + 30):
        log.write(HERE, 1001, MailboxType.COE, Reason.DENIED)
    assert len(lines()) == BURST
    log.write(THERE, 1001, MailboxType.COE, Reason.DENIED)
    assert len(lines()) == BURST + 1
    clock.now += 1
    log.write(HERE, 1001, MailboxType.COE, Reason.DENIED)
    assert lines()[-1].endswith("; 30 lines like it left out")


def test_only_so_many_clients_are_remembered(lines, monkeypatch):
    monkeypatch.setattr(module, "MAX_CLIENTS", 1)
    log = RefusalLog("mill/bus0", Clock())
    for _ in range(BURST + 1):
        log.write(HERE, 1001, MailboxType.COE, Reason.DENIED)
    log.write(THERE, 1001, MailboxType.COE, Reason.DENIED)
    log.write(HERE, 1001, MailboxType.COE, Reason.DENIED)
    assert len(lines()) == BURST + 2
