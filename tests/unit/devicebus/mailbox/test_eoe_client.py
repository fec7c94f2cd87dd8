from __future__ import annotations

from contextlib import suppress
from ipaddress import IPv4Address

import pytest
from hypothesis import given
from hypothesis import strategies as st

from devicebus.errors import BusError, EoeError, MailboxProtocolError
from devicebus.mailbox import eoe_client
from devicebus.mailbox.eoe_server import EoeServer
from devicebus.mailbox.protocol import MailboxSizes
from eap.codec.eoe import EoeResult, IpSettings
from eap.codec.mailbox import MailboxType
from eap.ids import MacAddr
from tests.support.mailbox import open_line, run_with, talk_to
from tests.support.vectors import load

EOE = MailboxType.EOE
REQUEST, RESPONSE, FRAME = [vector.octets[6:] for vector in load("eoe_mailbox")][:3]


def test_captured_exchange() -> None:
    settings = IpSettings.decode(REQUEST[4:])
    _, asked = run_with(EOE, eoe_client.set_ip(settings), [FRAME, RESPONSE])
    assert asked == [REQUEST]


def test_settings_go_to_our_slave_and_back() -> None:
    sizes = MailboxSizes()
    line = open_line(EOE, EoeServer(sizes), sizes)
    settings = IpSettings(
        MacAddr.parse("02:00:00:00:00:01"), IPv4Address("10.0.0.1"), name="axis 1"
    )
    line.run(eoe_client.set_ip(settings))
    assert line.run(eoe_client.get_ip()) == settings


def test_refusal_is_raised_with_its_result() -> None:
    with pytest.raises(EoeError, match=r"EoE set IP: DHCP is not supported \(0x0202\)") as caught:
        talk_to(EOE, eoe_client.set_ip(IpSettings()), "0300 0202")
    assert caught.value.result == EoeResult.NO_DHCP


@pytest.mark.parametrize("answer", ["", "07", "0700 0000", "0700 0000 02000000 0a"])
def test_answer_that_breaks_the_protocol(answer: str) -> None:
    with pytest.raises(MailboxProtocolError, match="EoE get IP"):
        talk_to(EOE, eoe_client.get_ip(), answer)


@given(st.lists(st.binary(max_size=20), max_size=5))
def test_any_answers_end_in_settings_or_a_named_error(noise: list[bytes]) -> None:
    # A mailbox never carries an empty message, so a slave cannot send one.
    with suppress(BusError):
        talk_to(EOE, eoe_client.get_ip(), *[b"\7" + octets for octets in noise])
