from __future__ import annotations

import pytest

from devicebus.errors import MailboxProtocolError
from devicebus.mailbox import aoe_client
from devicebus.mailbox.aoe_server import AmsAnswer, AoeServer
from devicebus.mailbox.protocol import MailboxSizes
from eap.codec.ams import AmsHeader, StateFlags, encode_packet
from eap.codec.mailbox import MailboxType
from eap.ids import NetId
from tests.support.mailbox import open_line, run_with, talk_to

AOE = MailboxType.AOE
HERE, SLAVE = NetId.parse("1.2.3.4.5.6"), NetId.parse("6.5.4.3.2.1")
READ = AmsHeader(SLAVE, 1001, HERE, 300, 2, invoke_id=7)


def reply(
    *, source: NetId = SLAVE, port: int = 1001, command: int = 2, flags: int = 5, invoke_id: int = 7
) -> bytes:
    header = AmsHeader(HERE, 300, source, port, command, flags, invoke_id=invoke_id)
    return encode_packet(header, b"answer")


def test_exchange_takes_the_answer_to_its_request() -> None:
    others = [
        reply(source=HERE),
        reply(port=1002),
        reply(command=3),
        reply(flags=StateFlags.ADS),
        reply(invoke_id=8),
    ]
    (header, data), asked = run_with(AOE, aoe_client.exchange(READ, b"ask"), [*others, reply()])
    assert (header.invoke_id, data) == (7, b"answer")
    assert asked == [encode_packet(READ, b"ask")]


def test_exchange_with_our_slave() -> None:
    line = open_line(
        AOE, AoeServer(lambda header, data: AmsAnswer(data[::-1]), MailboxSizes()), MailboxSizes()
    )
    header, data = line.run(aoe_client.exchange(READ, b"abc"))
    assert (header.source, header.error_code, data) == (SLAVE, 0, b"cba")


@pytest.mark.parametrize("answer", [reply()[:31], reply()[:-1]])
def test_answer_that_is_cut_breaks_the_protocol(answer: bytes) -> None:
    with pytest.raises(MailboxProtocolError, match=r"AoE answer of 6\.5\.4\.3\.2\.1:1001"):
        talk_to(AOE, aoe_client.exchange(READ, b""), answer)
