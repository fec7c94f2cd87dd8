"""What a master shows of the configuration of a slave."""

from __future__ import annotations

import msgspec
import pytest

from devicebus.wire.register import DlStatus
from eap.appliance.bus_request import SlaveReport
from eap.appliance.services.master.configured_values import configured_value, link_status
from eap.appliance.services.master.slave_facts import Facts
from eap.od.profiles.master1100 import Live

SLAVE = SlaveReport(
    station=1001, name="axis", vendor=1, product=2, revision=3, serial=4, alias=0, state=8,
    target=8, order="AX5000", usual_to_slave=256, usual_to_master=128, port_physics=0x31,
    protocols=4, link_preset=0x11,
)  # fmt: skip
WIRED = DlStatus(link=0b0011, communication0=1, communication1=1)


def test_what_is_configured() -> None:
    facts = Facts(0x0002_0192, has_history=True)
    shown = {
        Live.TYPE: "AX5000",
        Live.NAME: "axis",
        Live.DEVICE_TYPE: 0x0002_0192,
        Live.MAILBOX_OUT: 256,
        Live.MAILBOX_IN: 128,
        Live.LINK_STATUS: 0,
        Live.LINK_PRESET: 0x11,
        Live.FLAGS: 0,
        Live.PHYSICS: 0x31,
        Live.HAS_HISTORY: True,
    }
    assert {key: configured_value(SLAVE, WIRED, facts, key) for key in shown} == shown


def test_a_mailbox_that_is_open_tells_its_own_size() -> None:
    slave = msgspec.structs.replace(SLAVE, to_slave=512, to_master=64, order="")
    keys = (Live.MAILBOX_OUT, Live.MAILBOX_IN, Live.TYPE)
    values = [configured_value(slave, WIRED, Facts(), key) for key in keys]
    assert values == [512, 64, "axis"]


@pytest.mark.parametrize(
    ("dl", "expected"),
    [
        (WIRED, 0),
        (DlStatus(link=0b0001, communication0=1), 0x24),
        (DlStatus(link=0b0011, communication0=1), 0x22),
        (DlStatus(link=0b0111, communication0=1, communication1=1, communication2=1), 0x48),
        (DlStatus(link=0b1001, communication0=1, communication3=1), 0xAC),
    ],
)
def test_links_are_compared_with_those_that_were_found(dl, expected) -> None:
    assert link_status(SLAVE, dl) == expected


def test_a_slave_that_does_not_answer_has_no_link() -> None:
    assert link_status(msgspec.structs.replace(SLAVE, state=0), WIRED) == 1
