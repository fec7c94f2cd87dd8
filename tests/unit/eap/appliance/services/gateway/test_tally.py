"""Counts by slave and protocol."""

from __future__ import annotations

from eap.appliance.services.gateway.tally import Tally
from eap.codec.mailbox import MailboxType
from eap.gateway.refusal import Reason


def test_rows() -> None:
    tally = Tally()
    tally.note(1001, MailboxType.COE, [None], 2_000_000)
    tally.note(1001, MailboxType.COE, [None, None], 4_000_000)
    tally.note(1001, MailboxType.COE, [Reason.TIMEOUT], 900_000_000)
    tally.note(0, MailboxType.FOE, [Reason.NO_PROTOCOL], 1)
    tally.note(1001, MailboxType.FOE, [], 1)
    master, coe, foe = tally.report()
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


def test_whoever_asks_for_every_address_there_is_fills_nothing() -> None:
    tally = Tally()
    for address in range(6000):
        tally.note(address, MailboxType.COE, [Reason.NO_SLAVE], 1)
    assert len(tally.report()) == 4096
