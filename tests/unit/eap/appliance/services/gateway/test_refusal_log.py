from __future__ import annotations

from eap.aoe.way import Way
from eap.appliance.services.gateway.refusal_log import RefusalLog
from eap.codec.mailbox import MailboxType
from eap.gateway.refusal import Reason

HERE, THERE = Way("udp:eap0", "10.0.0.8:1"), Way("udp:eap0", "10.0.0.9:1")


def test_who_was_refused_what(caplog):
    log = RefusalLog("mill/bus0")
    log.write(HERE, 1001, MailboxType.COE, Reason.DENIED)
    log.write(HERE, 1009, MailboxType.COE, Reason.NO_SLAVE)
    (line,) = caplog.messages
    assert line == (
        "gateway mill/bus0: COE of 10.0.0.8:1 (udp:eap0) to address 1001 refused: access refused:"
        " the plant file has no rule that allows it"
    )


def test_refusal_log_client_that_asks_again_is_the_same_cause_and_another_is_not(caplog):
    log = RefusalLog("mill/bus0")
    again = HERE._replace(connection="10.0.0.8:2")
    for way in (HERE, again, THERE):
        log.write(way, 1001, MailboxType.COE, Reason.DENIED)
    log.write(HERE, 1002, MailboxType.COE, Reason.DENIED)
    first, second, *others = (record.cause for record in caplog.records)
    assert first == second
    assert len({first, *others}) == 3
