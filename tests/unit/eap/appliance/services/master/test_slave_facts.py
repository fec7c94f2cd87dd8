"""What slaves say of themselves is asked once."""

from __future__ import annotations

import asyncio
from typing import Any

import msgspec
import pytest

from devicebus.errors import MailboxTimeoutError
from devicebus.mailbox.conversation import Message
from devicebus.wire.sii import SiiProtocol
from eap.appliance.bus_request import SlaveReport
from eap.appliance.handover import PortName
from eap.appliance.services.master import slave_facts
from eap.appliance.services.master.slave_facts import Facts, SlaveFacts
from eap.codec.mailbox import MailboxType

SLAVE = SlaveReport(
    station=1001, name="s", vendor=1, product=2, revision=3, serial=4, alias=0, state=8, target=8,
    to_slave=64, to_master=64, protocols=int(SiiProtocol.COE),
)  # fmt: skip
TYPE = "0030 43 0010 00 92010200"
HISTORY, NO_HISTORY = "0030 4f f310 00 05000000", "0020 80 f310 00 00000206"


class Bus:
    def __init__(self, *replies: str) -> None:
        self.replies = list(replies)
        self.asked = 0

    async def converse(self, port: PortName, station: int, conversation: Any, *, requester: str):
        self.asked += 1
        if not self.replies:
            conversation.close()
            raise MailboxTimeoutError("no answer")
        next(conversation)
        try:
            for octets in self.replies:
                conversation.send(Message(MailboxType.COE, bytes.fromhex(octets)))
        except StopIteration as end:
            return end.value
        return await asyncio.sleep(9)


def ask(bus: Bus, *slaves: SlaveReport) -> SlaveFacts:
    facts = SlaveFacts(bus, PortName("a", "bus0"))  # type: ignore[arg-type]

    async def run() -> None:
        for slave in slaves:
            await facts.ask(slave)

    asyncio.run(run())
    return facts


def test_a_slave_is_asked_once_until_it_was_gone() -> None:
    bus = Bus(TYPE, HISTORY)
    facts = ask(bus, SLAVE, SLAVE)
    assert facts.of(1001) == Facts(0x0002_0192, has_history=True)
    assert facts.of(1002) == Facts()
    assert bus.asked == 1
    facts.forget([1001, 1002])
    assert not facts.is_known(SLAVE)
    assert ask(Bus(TYPE, NO_HISTORY), SLAVE).of(1001) == Facts(0x0002_0192)


def test_who_does_not_answer_is_asked_no_more(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(slave_facts, "_ANSWER_S", 0.01)
    for bus in (Bus(), Bus(TYPE)):
        facts = ask(bus, SLAVE)
        assert facts.of(1001) == Facts()
        assert facts.is_known(SLAVE)


def test_who_has_no_dictionary_is_not_asked() -> None:
    bus = Bus()
    ask(bus, *(msgspec.structs.replace(SLAVE, **{key: 0}) for key in ("to_slave", "protocols")))
    assert bus.asked == 0
